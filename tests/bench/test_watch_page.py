"""A twin watches the page's firmware, and a press of its button has the engine look at what it saw last.

The report of a diagnosis on the page is that of ``test_browser_work``; here the job is cancelled once it runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.bench.conftest import Server, bench_server, go, opened_page
from tests.unit.mismatch_watch.test_live import STACK_TWIN
from tools.mismatch.recording_load import load

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

REFERENCE_S = 15.0


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    twin = tmp_path_factory.mktemp("watched") / "twin.toml"
    twin.write_text(STACK_TWIN)
    with bench_server(options=("--watch", str(twin), "--watch-reference", f"{REFERENCE_S:g}")) as running:
        yield running


def test_the_button_diagnoses_what_the_twin_saw_last(browser: Any, watched: Server, artefacts: Any):
    with opened_page(browser, watched) as page:
        go(page, "mismatch")
        before = watched.wait_for(lambda s: (s["watch"] or {}).get("phase") == "watching", "the end of the reference")
        button = page.locator(".watch button", has_text="Diagnose the last minute")
        page.wait_for_function("!document.querySelector('.watch button').disabled")
        answers = []
        for _ in range(2):
            with page.expect_response("**/api/mismatch/last-minute") as answer:
                button.click()
            answers.append((answer.value.status, answer.value.json()))
        (status, job), (again, refusal) = answers
        assert (status, job["title"], job["state"]) == (200, "diagnose the last minute", "running")
        assert again == 400
        assert "is still running" in refusal["error"]
        page.get_by_role("alert").filter(has_text="is still running").wait_for()
        (folder,) = watched.folder.glob("micron-jobs-*/*/recording")
        recording = load(folder)
        assert recording.twin.kind == "piezo_stack"
        assert 1000 * REFERENCE_S <= recording.n <= 60_000
        assert set(recording.outputs) == {"displacement"}
        page.screenshot(path=artefacts / "last-minute.png")
        page.locator("button", has_text="Cancel").click()
        page.wait_for_function(
            "document.querySelector('.mismatch').innerText.includes('diagnose the last minute: cancelled')"
        )
        after = watched.state()
        assert (after["phase"], after["run"], after["watch"]["phase"]) == ("running", before["run"], "watching")

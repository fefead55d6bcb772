"""``micron reproduce measured``: the engine sees the fit part alone, the test is scored once, rows are honest."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.unit.mismatch_model.test_cascade import PRODUCT, circuit, matrices, unit_gain
from tools.cli.main import app
from tools.errors import InputError
from tools.mismatch.engine.pose import opened
from tools.mismatch.recording_load import load
from tools.mismatch.twins.cascade import CascadeTwin
from tools.mismatch.twins.make import make
from tools.research.prove.disk import toml_text
from tools.research.reproduce import measured, measured_rows
from tools.research.reproduce.measured import chosen, score, sealed, write_part
from tools.research.reproduce.measured_page import document
from tools.research.reproduce.measured_rows import Scored, rows_of
from tools.research.reproduce.measured_sets import SETS, Goal, MeasuredSet, Published
from tools.research.reproduce.names import expand


def scored(name: str, corrected: float | None, names: tuple[str, ...], **changes: Any) -> Scored:
    physics = [{"name": n, "stage": "mechanics", "confidence": 0.9, "parameters": {}} for n in names]
    report = {"verdict": "missing_physics", "summary": "Something.", "physics": physics, "location": {}}
    given = {"given": 9.0, "refitted": 8.0, "floor": 0.1, "left": (("force", "rate", 0.4),), "cpu_s": 3.0}
    return Scored(**{"name": name, "report": report, "corrected": corrected, "revision": "abc", **given, **changes})


def test_every_set_with_a_twin_is_there_and_the_old_name_works() -> None:
    for part in ("emps", "silverbox", "tanks", "wiener", "bouc", "coupled", "piezo", "f16", "accelerometer"):
        assert chosen([part])
    assert len({s.name for s in SETS}) == len(SETS) == 12
    assert expand(["mismatch-real"]) == ["measured"]
    with pytest.raises(InputError, match="silverbox multisine"):
        chosen(["nosuch"])


def test_a_goal_asks_for_the_right_names_and_nothing_but_them() -> None:
    goal = Goal(1.0, (("a", "b"), ("c",)), ("d",))
    assert goal.names_meet(["a", "c"])
    assert goal.names_meet(["c", "b", "d"])
    assert not goal.names_meet(["a"])
    assert not goal.names_meet(["a", "c", "e"])
    assert Goal(1.0).names_meet(["anything"])


def test_a_good_figure_under_a_wrong_name_meets_no_goal() -> None:
    right = rows_of(scored("silverbox multisine", 0.25, ("cubic_stiffness",)))
    wrong = rows_of(scored("silverbox multisine", 0.25, ("cubic_stiffness", "resonance")))
    assert [r.meets for r in right] == [True, True, True]
    assert [r.meets for r in wrong] == [True, True, False]
    assert math.isnan(wrong[-1].ours)
    assert "resonance" in wrong[-1].why


def test_a_figure_that_is_missed_says_what_is_left_by_the_engine() -> None:
    row = rows_of(scored("emps", 5.0, ("coulomb_friction",)))[0]
    assert not row.meets
    assert row.why == "what is left on the test follows force (rate: 40 %)"
    failed = rows_of(scored("emps", None, (), error="ValueError: no"))
    assert {(r.meets, r.why.endswith("ValueError: no")) for r in failed} == {(False, True)}
    page = document([scored("emps", 5.0, ("coulomb_friction",))])
    assert "What is left on the test follows force (rate: 40 %)." in page
    assert "| emps | mm | 9 | 8 | 5 | 0.1 |" in page
    assert "Not run for this page: silverbox multisine" in page


def test_sets_that_were_not_run_keep_the_rows_and_sections_of_the_page_before() -> None:
    both = [scored("emps", 5.0, ("coulomb_friction",)), scored("silverbox multisine", 0.25, ("cubic_stiffness",))]
    before = document(both)
    again = document([scored("emps", 2.0, ("coulomb_friction",))], before)

    def kept(page: str) -> str:
        return page[page.index("## second-order circuit") :]

    assert kept(again) == kept(before)
    (row,) = (line for line in before.splitlines() if line.startswith("| silverbox multisine |"))
    assert row in again.splitlines()
    assert "| emps | mm | 9 | 8 | 2 | 0.1 |" in again
    assert "| emps | mm | 9 | 8 | 5 | 0.1 |" not in again
    assert "2 of 2 goals are met" in again
    assert "Run anew for this page: emps." in again


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of one set: a stack with a dead zone, fit and test in files of their own."""
    data = tmp_path / "data" / "emps"
    data.mkdir(parents=True)
    for seed, name in ((1, "train"), (2, "test")):
        rng, t = np.random.default_rng(seed), np.arange(1200) / 100.0
        u = 50 + sum(9 * np.sin(2 * np.pi * f * t + p) for f, p in rng.uniform(0.1, 2.0, (5, 2)))
        z = 0.13 * (u - np.clip(u - 50.0, -4.0, 4.0)) - 1.0 + rng.normal(0, 0.01, t.size)
        np.savez(data / f"{name}.npz", u=u, z=z)
        (data / f"{name}.toml").write_text(
            f'format = 1\ndata = "{name}.npz"\nrate_hz = 100.0\n[twin]\nkind = "piezo_stack"\n[twin.parameters]\n'
            "gain_um_per_V = 0.125\noffset_um = -1.0\n"
            '[[channels]]\ncolumn = "u"\nrole = "input"\nsignal = "command"\nunit = "V"\n'
            '[[channels]]\ncolumn = "z"\nrole = "output"\nsignal = "displacement"\nunit = "um"\n'
        )
    monkeypatch.setenv("MICRON_DATA", str(tmp_path / "data"))
    return tmp_path


STACK = MeasuredSet(
    "stack", "a stack", ("emps/train.toml", None), ("emps/test.toml", None), "displacement", "nm", 1e3, 0,
    (Published(20.0, "a guess", "nobody"),), "A dead zone.", Goal(12.0, (("dead_zone",),)),
)  # fmt: skip


def test_the_engine_never_sees_the_test_and_the_file_is_scored(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    from tools.research.reproduce import measured

    real = measured.diagnose

    def watched(recording: Any, **options: Any) -> Any:
        seen.append(recording.n)
        return real(recording, **options)

    monkeypatch.setattr(measured, "diagnose", watched)
    done = score(STACK, made / "work", {})
    assert done.error == ""
    assert seen == [1200]
    assert done.named == ("dead_zone",)
    assert done.corrected == pytest.approx(10.0, rel=0.2)
    assert done.given is not None
    assert done.given > 100.0
    assert [r.meets for r in rows_of_stack(done, monkeypatch)] == [True, True]


def rows_of_stack(done: Scored, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    monkeypatch.setattr(measured_rows, "SETS", (STACK,))
    return rows_of(done)


def test_a_run_goes_on_where_it_was_stopped(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command, its JSON, its page; a set that the rows hold is not run again."""
    asked: list[str] = []

    def quick(s: MeasuredSet, folder: Path, diagnosed: object) -> Scored:
        asked.append(s.name)
        return scored(s.name, 5.0, ("coulomb_friction",))

    monkeypatch.setattr(measured, "score", quick)
    words = ["reproduce", "measured", "--rows", str(made / "rows.json"), "--json", str(made / "out.json")]
    words += ["--out", str(made / "page.md")]
    for sets in (["--set", "emps"], ["--set", "emps", "--set", "tanks"]):
        result = CliRunner().invoke(app, [*words, *sets])
        assert result.exit_code == 0, result.output
    assert asked == ["emps", "cascaded_tanks"]
    body = json.loads((made / "out.json").read_text())
    assert body["name"] == "measured"
    assert {"set", "named", "cpu_s", "revision", "verdict", "meets"} <= set(body["rows"][0])
    assert "page" not in body
    assert (made / "page.md").read_text().startswith("# The mismatch tool on measured recordings")
    assert CliRunner().invoke(app, ["reproduce", "sensing", "--set", "emps"]).exit_code == 2
    assert CliRunner().invoke(app, ["reproduce", "measured", "--set", "nosuch"]).exit_code == 2


def test_the_refit_of_a_twin_that_the_engine_wrote_as_two_filters_is_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "data").mkdir()
    monkeypatch.setenv("MICRON_DATA", str(tmp_path / "data"))
    u, y = circuit(12000, 0.4)
    np.savez(tmp_path / "data" / "train.npz", u=u, y=y)
    believed = {**matrices(*PRODUCT, unit_gain(*PRODUCT)), "discrete": True}
    channels = [{"column": c, "role": r, "signal": c, "unit": "V"} for c, r in (("u", "input"), ("y", "output"))]
    table = {"format": 1, "data": "train.npz", "rate_hz": 100.0, "channels": channels}
    (tmp_path / "data" / "train.toml").write_text(
        toml_text(table | {"twin": {"kind": "state_space", "parameters": believed}})
    )
    s = MeasuredSet("c", "a circuit", ("train.toml", None), ("train.toml", (8000, 12000)), "y", "V", 1.0, 20, (), "")
    fit = write_part(s, tmp_path / "fit", *s.fit)
    twin = make(opened(load(fit)))
    assert isinstance(twin, CascadeTwin)
    theta = twin.start(load(fit))
    shifts = [{"name": p.name, "alone": v, "with_effects": v} for p, v in zip(twin.parameters, theta, strict=True)]
    report = {"format": 1, "verdict": "recalibrate", "twin": "state_space", "physics": []}
    report |= {"fit": {"unit": {"y": "V"}, "base_parameters": shifts}, "corrected_base": twin.to_text(theta)}
    figures, _ = sealed(s, fit, report, tmp_path)
    assert figures[1] == pytest.approx(figures[2], rel=1e-6)
    assert figures[1] < 1.5 * figures[0]


@pytest.mark.parametrize("text", ["[]", "{", '{"format": 1}', '{"emps": {"left": 3}}', '{"emps": {"left": []}}'])
def test_a_file_of_another_kind_holds_no_finished_sets(tmp_path: Path, text: str) -> None:
    rows = tmp_path / "rows.json"
    rows.write_text(text)
    with pytest.raises(InputError, match=r"rows\.json: no .*name a new file, or one of an earlier run"):
        measured.table(["emps"], rows)
    assert rows.read_text() == text

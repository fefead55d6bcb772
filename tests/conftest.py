"""Options of the hardware tests: which bench, and how much they may disturb it."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# the same draws on every machine, so that a change fails for what it changed; .ci/nightly draws anew
settings.register_profile("same", derandomize=True)
settings.load_profile("same")

DEFAULT_BENCH = Path(__file__).parents[1] / "benches" / "micron.toml"


def with_keys(bench: str, table: str, keys: str) -> str:
    """Return the text of a bench with the lines ``keys`` in ``[table]``, which may be there already."""
    head = f"[{table}]\n"
    return bench.replace(head, head + keys) if head in bench else f"{bench}\n{head}{keys}"


def copy_of_default_bench(folder: Path, more_toml: str) -> Path:
    """The default bench with ``more_toml`` at its end, in ``folder``."""
    text = DEFAULT_BENCH.read_text().replace('"calibration/', f'"{DEFAULT_BENCH.parent / "calibration"}/')
    path = folder / "bench.toml"
    path.write_text(text + more_toml, encoding="utf-8")
    return path


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--bench", default=None, help="bench file of the hardware tests; default: the emulated bench")
    parser.addoption(
        "--max-effect",
        type=int,
        default=None,
        help="0 reads, 1 configures, 2 small output, 3 full range, 4 motion; default 1, on the emulated bench 4",
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out tests that disturb more than allowed (they are counted); what needs the bench page comes last."""
    chosen = config.getoption("--bench")
    limit = config.getoption("--max-effect")
    limit = limit if limit is not None else (4 if chosen is None else 1)
    kept, left_out = [], []
    for item in items:
        marker = item.get_closest_marker("effect")
        (left_out if marker is not None and marker.args[0] > limit else kept).append(item)
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = kept
    # the bench page's server and the browser run from the first test that needs them to the end of the session, and the
    # browser's library keeps an event loop in the process: nothing else comes after them
    items.sort(key=lambda item: bool({"server", "browser"} & set(getattr(item, "fixturenames", ()))))


@pytest.fixture(scope="session", autouse=True)
def state_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Decisions about other people's programs that tests record are not the user's."""
    folder = tmp_path_factory.mktemp("state")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder))
        yield folder


@pytest.fixture(autouse=True)
def signal_handlers() -> Iterator[None]:
    """Put the handlers of SIGINT and SIGTERM back after each test: processes that later ones start inherit a signal
    that is ignored, and could not be ended."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        if handler is not None:  # one that Python did not install cannot be put back
            signal.signal(number, handler)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The real recordings beside the project; tests that need them are skipped where they are not."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the recordings are not here: {folder}")
    return folder

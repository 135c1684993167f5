"""Fixtures that every test room shares."""

import ctypes
import fcntl
import gc
import os
import pickle
import shutil
import socket
import struct
import sys
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar

# Each capture draws its figure in a process that is forked for it. What is loaded here need not be loaded there.
import matplotlib.backends.backend_agg  # noqa: F401
import matplotlib.figure
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]

CLONE_NEWNET = 0x40000000
SIOCSIFFLAGS = 0x8914
IFF_UP = 1


#: Larger files of a synthetic capture are not kept.
MOST_BYTES = 2 << 20
#: How many tests marked `long` a run leaves out.
LEFT_OUT = pytest.StashKey[int]()
#: What test processes are forked from.
SERVER = pytest.StashKey[Any]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--rig FILE` names the rig that tests/hardware may move; `--all` runs the tests marked `long` as well."""
    parser.addoption("--rig", default=None, help="rig file of real hardware for tests/hardware")
    parser.addoption("--all", action="store_true", help="run the tests marked `long` as well")


@pytest.fixture(scope="session", autouse=True)
def _own_home(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep rig files and alarms of tests apart from those of whoever tests."""
    os.environ["XDG_CONFIG_HOME"] = str(tmp_path_factory.mktemp("config"))
    os.environ["XDG_RUNTIME_DIR"] = str(tmp_path_factory.mktemp("runtime"))


def pytest_configure(config: pytest.Config) -> None:
    """Give each test process a loopback interface of its own, where it may.

    The simulated camera occupies a fixed port of 127.0.0.1: with a network of their own, parallel test processes do
    not wait for each other's. Needs root; without it the tests run as they are, one process at a time (`./lab test`).
    Real hardware is reached over the real network.

    Whoever selects tests (by a path, -k or -m) gets all that they select.

    What is collected stays: a fifth of the time would go into looking for garbage in it.
    """
    gc.disable()
    named = config.args_source is pytest.Config.ArgsSource.ARGS
    config.option.all |= named or bool(config.option.keyword or config.option.markexpr)
    if config.getoption("--rig") is not None:
        return
    if os.geteuid() == 0 and ctypes.CDLL(None, use_errno=True).unshare(CLONE_NEWNET) == 0:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
            fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sH14x", b"lo", IFF_UP))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config, specs: list[Any]) -> None:
    """Let all test processes share one collection."""
    from tests.worker_server import WorkerServer

    config.stash[SERVER] = WorkerServer(config.invocation_params.args)
    for spec in specs:
        spec.python = config.stash[SERVER].command


def pytest_unconfigure(config: pytest.Config) -> None:
    """End the server of test processes."""
    if SERVER in config.stash:
        config.stash[SERVER].close()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests marked `long`, or let every test process begin with its share of the files that have some.

    Each gets an equal number of tests, in the order of `items`; one that has ended takes half of what another has left,
    from the end. A long test there would be the last to run, with nothing beside it. A file stays whole: what its tests
    share is made once.
    """
    long = {item for item in items if item.get_closest_marker("long")}
    if not config.option.all:
        config.stash[LEFT_OUT] = len(long)
        config.hook.pytest_deselected(items=[*long])
        items[:] = [item for item in items if item not in long]
        return
    processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if processes == 1:
        return
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    weights = {path: len(long.intersection(tests)) for path, tests in files.items()}
    shares: list[list[pytest.Item]] = [[] for _ in range(processes)]
    for path in sorted(filter(weights.get, files), key=lambda path: -weights[path]):
        min(shares, key=lambda share: len(long.intersection(share))).extend(files[path])
    short = [item for path, tests in files.items() if not weights[path] for item in tests]
    dealt: list[pytest.Item] = []
    for n, first in enumerate(shares):
        count = max((len(items) - len(dealt)) // (processes - n) - len(first), 0)
        dealt += first + short[:count]
        del short[:count]
    items[:] = dealt + short


def pytest_collection_finish() -> None:
    """Keep the collected tests out of garbage collection: each full one would walk half a million objects."""
    gc.freeze()
    gc.enable()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Let a test process report how many tests it leaves out."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["left_out"] = session.config.stash.get(LEFT_OUT, 0)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take the number that a test process reports; all of them collect the same tests."""
    node.config.stash[LEFT_OUT] = getattr(node, "workeroutput", {}).get("left_out", 0)


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print how many tests were left out, and how to run them."""
    if count := config.stash.get(LEFT_OUT, 0):
        terminalreporter.write_line(f"{count} long tests left out; run them too: ./lab test --all", yellow=True)


@pytest.fixture(scope="session")
def public_files() -> Callable[[str], dict[str, Path]]:
    """Files of a set of public measured data by its name (docs/measured-data.md); each was checked.

    Sets in tests/data are there everywhere. For the others the folder UMOV_DATA, or ../shared/data, is used: without
    them a test skips, in CI it fails.
    """
    from processing.public_data.sets import SHIPPED, find_files

    data = Path(os.environ.get("UMOV_DATA", ROOT.parent / "shared" / "data"))

    @cache
    def files(name: str) -> dict[str, Path]:
        set_files = find_files(name, [SHIPPED, data])
        if set_files is None:
            message = f"the data set {name} is not in {data}; get it: ./lab data get {name}, UMOV_DATA=data"
            if os.environ.get("CI"):
                pytest.fail(message)
            pytest.skip(message)
        return set_files

    return files


@pytest.fixture(scope="session")
def configs() -> Path:
    """The repository's configuration files."""
    return ROOT / "configs"


@pytest.fixture
def small_rig(configs: Path, tmp_path: Path) -> Callable[..., Path]:
    """Makes a simulated rig file with small frames and a fast clock; keywords change its `simulator` section."""
    from tests.rig_files import write_rig

    def make(name: str = "rig.yaml", top: dict | None = None, **simulator: object) -> Path:
        return write_rig(configs, tmp_path / name, top, **simulator)

    return make


@pytest.fixture
def default_rig(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], None]:
    """Makes a rig file the default one for this test alone; a module that is first imported then would keep it."""

    def use(path: Path) -> None:
        for module in ("by_hand", "campaign", "demo", "single", "defaults"):
            monkeypatch.setattr(f"acquisition.commands.{module}.DEFAULT_RIG", path)

    return use


@pytest.fixture
def dim_instrument(configs: Path, tmp_path: Path) -> Path:
    """The default rig's Mueller polarimeter with a tenth of the light: a truth that is not what is declared."""
    from processing.instrument.model import InstrumentModel
    from processing.yaml_file import dump_yaml

    declared = InstrumentModel.load(configs / "instruments" / "rgb950.yaml")
    (channel,) = declared.channels
    path = tmp_path / "dim.yaml"
    dim = channel.model_copy(update={"gain": 0.1 * channel.gain})
    path.write_text(dump_yaml(declared.model_copy(update={"channels": (dim,)})))
    return path


@pytest.fixture
def run_main(capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs an entry point in this process; returns exit code, standard output and standard error."""
    from tests.commands import exit_code

    def run(main: Callable[[list[str]], None], *arguments: object, traceback: bool = False) -> tuple[int, str, str]:
        capfd.readouterr()
        code = exit_code(main, *arguments)
        out, err = capfd.readouterr()
        assert traceback or "Traceback" not in err
        return code, out, err

    return run


@pytest.fixture
def figures() -> None:
    """For tests of which `acquire` and `process` shall draw the figure of a capture or product."""


@pytest.fixture
def acquire(
    run_main: Callable[..., tuple[int, str, str]], request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Any:
    """Runs `acquire`, as `run_main` does; a thread of it may fail with a traceback.

    Half of the processor time of a small capture goes into its figure: only tests with `figures` draw it.
    """
    from acquisition.commands.application import main
    from tests.commands import Program

    if "figures" not in request.fixturenames:
        monkeypatch.setattr("acquisition.screen.quicklook.draw", lambda path: path.with_suffix(".png"))
    return Program(partial(run_main, main, traceback=True))


@pytest.fixture
def process(
    run_main: Callable[..., tuple[int, str, str]], request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Any:
    """Runs `process`, as `run_main` does; without `figures` a figure is an empty file."""
    from processing.commands.application import main
    from tests.commands import Program

    if "figures" not in request.fixturenames:
        monkeypatch.setattr("processing.reports.figures.draw_product", lambda path, figure: figure.touch())
        save = matplotlib.figure.Figure.savefig

        def touch(figure: matplotlib.figure.Figure, to: Any, **options: Any) -> None:
            Path(to).touch() if isinstance(to, str | Path) else save(figure, to, **options)

        monkeypatch.setattr("matplotlib.figure.Figure.savefig", touch)
    return Program(partial(run_main, main))


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of the browser; CI has one."""
    program = shutil.which("chromium")
    if program is None:
        if os.environ.get("CI"):
            pytest.fail("CI needs chromium")
        pytest.skip("no chromium here")
    return program


@pytest.fixture
def browser(chromium: str) -> Iterator[Any]:
    """Debian's Chromium, without a window."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-dev-shm-usage"])
        yield opened
        opened.close()


@pytest.fixture(autouse=True)
def _disc_of_one_test() -> Iterator[None]:
    """A disc process has inherited what its test has patched: it ends with the test."""
    yield
    if "acquisition.disc" in sys.modules:
        sys.modules["acquisition.disc"].end_disc()


class SyntheticCapture:
    """Writes small captures with known content, straight into the file format (no bench, no drivers)."""

    #: Files without frames, by what was asked for: to lay one out takes most of the time.
    laid_out: ClassVar[dict[tuple[str, bytes], bytes]] = {}

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(
        self,
        frames: np.ndarray,
        angles_deg: dict[str, np.ndarray],
        *,
        name: str = "capture.h5",
        role: tuple[str, ...] | None = None,
        exposure_s: np.ndarray | float = 0.01,
        repeats: np.ndarray | int = 1,
        done: np.ndarray | int = 1,
        **header: Any,
    ) -> Path:
        """Write frames (states, channels, rows, columns) and angles; `header` are fields of CaptureHeader."""
        import h5py

        from processing.storage.captures.schema import CaptureHeader, create_layout, write_closing

        defaults = {"title": "synthetic", "simulated": True, "mode": "test", "wavelength_nm": 662.0}
        path = self.folder / name
        record = CaptureHeader.model_validate(defaults | header)
        roles = role or ("sample",) * len(frames)
        asked = repr((record, frames.shape, frames.dtype, roles)), pickle.dumps(angles_deg)
        if asked in self.laid_out:
            path.write_bytes(self.laid_out[asked])
        else:
            with h5py.File(path, "w") as h5:
                create_layout(
                    h5,
                    record,
                    angles_deg,
                    roles,
                    frame_shape=frames.shape[2:],
                    dtype=frames.dtype,
                    start_time="2026-01-01T00:00:00+00:00",
                )
            if path.stat().st_size < MOST_BYTES:
                self.laid_out[asked] = path.read_bytes()
        with h5py.File(path, "r+") as h5:
            h5["entry/instrument/detector/data"][...] = frames
            for axis, values in angles_deg.items():
                h5[f"entry/instrument/{axis}/value"][...] = values
            states = h5["entry/states"]
            states["exposure_s"][...], states["repeats"][...], states["done"][...] = exposure_s, repeats, done
            write_closing(h5, "complete", {})
        return path


@pytest.fixture(scope="session")
def captures_in() -> type[SyntheticCapture]:
    """Makes, of a folder, what writes captures with known frames there."""
    return SyntheticCapture


@pytest.fixture
def synthetic_capture(captures_in: type[SyntheticCapture], tmp_path: Path) -> SyntheticCapture:
    """A function that writes a capture with known frames into the test's own folder."""
    return captures_in(tmp_path)

"""Analysis on macOS and Windows by `pip install umov`: what Linux alone and what an extra has is taken away before."""

import json
import subprocess
import sys

import pytest

from processing.public_data.conversion import mirror_means
from processing.public_data.sets import SHIPPED

WITHOUT = """
import json, os, sys
names = "sched_getaffinity sched_setaffinity posix_fallocate posix_fadvise memfd_create fdatasync O_CLOEXEC O_NOFOLLOW"
for name in (names + " O_NONBLOCK O_NOCTTY O_DIRECTORY O_SYNC getuid geteuid nice pread pwrite syncfs sync").split():
    if hasattr(os, name):
        delattr(os, name)
modules = "fcntl termios resource pwd grp pty tty syslog numba llvmlite cv2 xarray pandas trimesh embreex"
for module in modules.split():
    sys.modules[module] = None
from processing.commands.program import main
for words in json.load(sys.stdin):
    try:
        main(words)
    except SystemExit as end:
        if end.code:
            print(words[:2], end.code)
"""


@pytest.mark.long
def test_import_reduce_and_diagnose_where_linux_has_no_part(tmp_path, configs):
    table = mirror_means(SHIPPED / "drr-imaging-630nm/roi_stats_630nm.csv")
    states = table.write(tmp_path)[0]

    instrument = configs / "instruments/drr_imaging_630nm.yaml"
    sample = ("--sample", "mirror", "--wavelength-nm", table.wavelength_nm, "--instrument", instrument)
    import_line = ("process", "import", "--states", states, "--out", "mirror.h5", *sample)
    steps = (("process", command, "mirror.h5") for command in ("reduce", "xi0", "quantities", "report"))
    refused = ("process", "export", "mirror.mueller.h5", "--to", "csv")
    words = [
        [str(word) for word in line]
        for line in (import_line, *steps, ("diagnose", "mirror.h5", "--json", "said.json"), refused)
    ]
    # In one program: it is loaded once.
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", WITHOUT],
        input=json.dumps(words),
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "residual 1.42 % -> 0.1" in done.stdout
    found = {effect["kind"] for effect in json.loads((tmp_path / "said.json").read_text())["effects"]}
    assert {"path_retardance", "retarder_transmission", "analyzer_transmission", "rotation_eccentricity"} <= found
    assert done.stdout.endswith("['process', 'export'] 2\n")
    assert done.stdout.count("['") == 1
    assert "needs xarray: pip install 'umov[xarray]'" in done.stderr

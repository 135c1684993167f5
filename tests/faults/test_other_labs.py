"""Tables and frames as other labs write them: imported as they are meant, or refused with what to type."""

import cv2
import h5py
import numpy as np
import pytest

from processing.storage.captures.capture import Capture
from processing.storage.formats.state_csv import read_states

ANGLES = {"psg": np.arange(6) * -12.5, "psa": np.arange(6) * -62.5}
#: Frames that differ: state k has the level 100 + k.
FRAMES = np.stack([np.full((4, 5), 100 + k, np.uint16) for k in range(6)])
SHUFFLED = (3, 0, 5, 1, 4, 2)
CAMERA = """\
kind: instrument
name: camera
generator: []
analyzer: []
channels:
  - {name: "0", elements: [{kind: polarizer, name: p0, azimuth_deg: 0}]}
  - {name: "45", elements: [{kind: polarizer, name: p45, azimuth_deg: 45}]}
  - {name: "90", elements: [{kind: polarizer, name: p90, azimuth_deg: 90}]}
  - {name: "135", elements: [{kind: polarizer, name: p135, azimuth_deg: 135}]}
mosaic: [["90", "45"], ["135", "0"]]
"""


@pytest.fixture
def lab(tmp_path):
    """Folder `Läufe` with a frame for each state."""
    (tmp_path / "Läufe").mkdir()
    for k, frame in enumerate(FRAMES):
        cv2.imwrite(str(tmp_path / "Läufe" / f"Bild {k + 7}.tif"), frame)


def levels(path):
    with Capture(path) as capture:
        return [int(capture.frames(k)[0, 0, 0]) for k in range(len(capture.role))], capture.angles_deg


def german(k):
    return f"{ANGLES['psg'][k]:.1f};{ANGLES['psa'][k]:.1f}".replace(".", ",")


@pytest.fixture
def log(tmp_path):
    lines = [f"C:\\Daten\\Bild {k + 7}.tif;{german(k)};12,5" for k in SHUFFLED]
    path = tmp_path / "Protokoll Messung.csv"
    path.write_bytes("\r\n".join(["Bild;Winkel [°];Analysator [°];Belichtung ms", *lines, ""]).encode("cp1252"))
    return ("--states", path, "--columns", "psg=Winkel [°]", "--columns", "psa=Analysator [°]")


@pytest.fixture
def drr(tmp_path):
    """An instrument for any wavelength."""
    path = tmp_path / "drr.yaml"
    path.write_text(
        "kind: instrument\nname: drr\n"
        "generator: [{kind: polarizer, name: p}, {kind: retarder, name: g, axis: psg, retardance_deg: 90}]\n"
        "analyzer: [{kind: retarder, name: a, axis: psa, retardance_deg: 90}, {kind: polarizer, name: q}]\n"
    )
    return ("--wavelength-nm", 633, "--instrument", path, "--out", tmp_path / "c.h5")


def test_frames_in_another_order_than_the_rows_are_never_mixed_up(lab, log, drr, tmp_path, process, process_refuses):
    stack = ("--stack", tmp_path / "Läufe")
    assert "Add --columns 'file=Bild'" in process_refuses("import", *log, *stack, *drr)
    assert process("import", *log, *stack, *drr, "--columns", "file=Bild")[0] == 0
    intensities, angles = levels(tmp_path / "c.h5")
    assert intensities == [100 + k for k in SHUFFLED]
    assert angles["psg"] == pytest.approx(ANGLES["psg"][list(SHUFFLED)])


def test_a_number_of_the_frame_in_another_order_is_asked_about(drr, lab, tmp_path, process, process_refuses):
    table = tmp_path / "log.txt"
    rows = [f"{k} {ANGLES['psg'][k]}  {ANGLES['psa'][k]}" for k in SHUFFLED]
    table.write_text("\n".join(["# rotator log", "frame  psg psa", *rows]) + "\n")
    options = ("--states", table, "--columns", "psg=psg", "--stack", tmp_path / "Läufe", *drr)
    err = process_refuses("import", *options)
    assert "--columns 'state=frame'" in err
    assert "--columns state=rows" in err
    assert process("import", *options, "--columns", "state=frame")[0] == 0
    assert levels(tmp_path / "c.h5")[1]["psg"] == pytest.approx(ANGLES["psg"])
    assert process("import", *options, "--columns", "state=rows", "--overwrite")[0] == 0
    assert levels(tmp_path / "c.h5")[1]["psg"] == pytest.approx(ANGLES["psg"][list(SHUFFLED)])


def test_times_in_milliseconds_are_not_taken_for_seconds(lab, log, drr, tmp_path, process, process_refuses):
    options = (*log, "--columns", "file=Bild", "--stack", tmp_path / "Läufe", *drr)
    err = process_refuses("import", *options, "--columns", "exposure_s=Belichtung ms")
    assert "--columns 'exposure_ms=Belichtung ms'" in err
    assert process("import", *options, "--columns", "exposure_ms=Belichtung ms")[0] == 0
    with h5py.File(tmp_path / "c.h5") as h5:
        assert h5["entry/states/exposure_s"][:] == pytest.approx(0.0125)


def test_angles_in_the_names_of_the_frames(drr, tmp_path, process, process_refuses):
    for k in range(6):
        name = f"G{ANGLES['psg'][k]:+.1f}_A{ANGLES['psa'][k]:.1f}.tif".replace(".", ",", 1)
        cv2.imwrite(str(tmp_path / name), FRAMES[k])
    assert "--stack 'FOLDER/name_{AXIS}.tif'" in process_refuses("import", "--stack", tmp_path, *drr)
    assert process("import", "--stack", tmp_path / "G{psg}_A{psa}.tif", *drr)[0] == 0
    intensities, angles = levels(tmp_path / "c.h5")
    states = [level - 100 for level in intensities]
    assert sorted(states) == list(range(6))
    assert angles["psa"] == pytest.approx(ANGLES["psa"][states])


def test_pages_of_a_tiff_are_states_and_none_is_dropped(lab, drr, tmp_path, process, process_refuses):
    cv2.imwritemulti(str(tmp_path / "run.tif"), list(FRAMES))
    np.savetxt(tmp_path / "angles.txt", np.stack(list(ANGLES.values()), axis=1))
    angles = ("--columns", f"psg={tmp_path}/angles.txt[0]", "--columns", f"psa={tmp_path}/angles.txt[1]")
    assert process("import", *angles, "--stack", tmp_path / "run.tif", *drr)[0] == 0
    assert levels(tmp_path / "c.h5")[0] == [100 + k for k in range(6)]
    cv2.imwritemulti(str(tmp_path / "Läufe" / "Bild 7.tif"), list(FRAMES[:2]))
    err = process_refuses("import", *angles, "--stack", tmp_path / "Läufe", *drr, "--overwrite")
    assert "Bild 7.tif: has 2 pages" in err


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_polarization_camera_needs_no_table(kind, tmp_path, process):
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "shots").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "shots" / f"shot {k}.png"), np.full((4, 6), 50 + k, kind))
    options = ("--wavelength-nm", 550, "--instrument", tmp_path / "camera.yaml", "--out", tmp_path / "c.h5")
    assert process("import", "--stack", tmp_path / "shots", *options)[0] == 0
    assert levels(tmp_path / "c.h5")[0] == [50, 51, 52]
    assert process("import", "--stack", tmp_path / "shots/shot 1.png", *options, "--overwrite")[0] == 0
    assert levels(tmp_path / "c.h5")[0] == [51]


def test_fields_and_rows_of_tables_in_hdf5(drr, tmp_path, process, process_refuses):
    with h5py.File(tmp_path / "run.h5", "w") as h5:
        motors = np.zeros(6, [("theta1", float), ("theta2", float)])
        motors["theta1"], motors["theta2"] = np.deg2rad(ANGLES["psg"]), np.deg2rad(ANGLES["psa"])
        h5["motors"], h5["both"], h5["images"] = motors, np.stack(list(ANGLES.values())), FRAMES
        h5["dark"] = np.moveaxis(np.zeros((2, 4, 5), np.uint16), 0, -1)
    file = tmp_path / "run.h5"
    options = ("--stack", f"{file}::/images", "--darks", f"{file}::/dark", *drr)
    fields = ("--columns", f"psg={file}::/motors[theta1]", "--columns", f"psa={file}::/motors[theta2]")
    assert "run.h5::/motors[theta1]'" in process_refuses("import", "--columns", f"psg={file}::/motors", *options)
    assert process("import", *fields, "--angles", "radians", *options)[0] == 0
    assert levels(tmp_path / "c.h5")[1]["psa"][:6] == pytest.approx(ANGLES["psa"])
    rows = ("--columns", f"psg={file}::/both[0]", "--columns", f"psa={file}::/both[1]")
    assert process("import", *rows, *options, "--overwrite")[0] == 0
    intensities, angles = levels(tmp_path / "c.h5")
    assert intensities == [100, 101, 102, 103, 104, 105, 0, 0]
    assert angles["psg"][:6] == pytest.approx(ANGLES["psg"])


def test_radians_are_named_by_their_header_and_degrees_are_not_taken_for_them(drr, lab, tmp_path, process_refuses):
    table = tmp_path / "log.csv"
    table.write_text("a (rad),b (rad)\n" + "".join(f"{4.0 * k},{20.0 * k}\n" for k in range(6)))
    options = ("--states", table, "--columns", "psg=a (rad)", "--columns", "psa=b (rad)", "--stack", tmp_path / "Läufe")
    assert "Add --angles radians" in process_refuses("import", *options, *drr)
    assert "Add --angles degrees" in process_refuses("import", *options, "--angles", "radians", *drr)


def test_a_missing_frame_is_named(drr, lab, tmp_path, process_refuses):
    (tmp_path / "Läufe" / "Bild 9.tif").unlink()
    np.save(tmp_path / "psg.npy", ANGLES["psg"])
    np.save(tmp_path / "psa.npy", ANGLES["psa"])
    angles = ("--columns", f"psg={tmp_path}/psg.npy", "--columns", f"psa={tmp_path}/psa.npy")
    err = process_refuses("import", *angles, "--stack", tmp_path / "Läufe", *drr)
    assert "5 frames for 6 states" in err
    assert "leave out 9" in err


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_tables_of_any_system(tmp_path, encoding):
    path = tmp_path / "t.csv"
    path.write_bytes("Winkel [°]\tx\t\r\n-7,5\t1\t\r\n372,5\t2\t\r\n".encode(encoding))
    states = read_states(path, ["psg"], {"psg": "Winkel [°]"})
    assert states.angles_deg["psg"].tolist() == [-7.5, 372.5]


def test_a_table_without_names_is_refused_with_what_to_type(lab, drr, tmp_path, process_refuses):
    np.savetxt(tmp_path / "t.txt", np.ones((6, 2)))
    options = ("--states", tmp_path / "t.txt", "--stack", tmp_path / "Läufe")
    assert "--columns 'psg=" in process_refuses("import", *options, *drr)


@pytest.mark.parametrize(
    "text",
    [
        "Date: 2026-11-25 10:12, operator Anna\nCamera X, 20 ms\n\nWinkel,psa\n-7.5,1\n372.5,2\n",
        "LabVIEW Measurement\t\n***End_of_Header***\t\nWinkel\tpsa\n-7.5\t1\t\n372.5\t2\t\n",
        "Winkel,psa\ndeg,deg\n-7.5,1\n372.5,2\n",
        'Winkel,psa\n"-7,5","1,0"\n"372,5","2,0"\n',
        "Winkel;psa\n-7,5°;1°\n372,5°;2 °\n",
    ],
    ids=["words before", "LabVIEW", "line of units", "quoted decimal commas", "degree signs"],
)
def test_tables_of_other_programs(tmp_path, text):
    path = tmp_path / "t.csv"
    path.write_text(text, encoding="utf-8")
    states = read_states(path, ["psg", "psa"], {"psg": "Winkel"})
    assert states.angles_deg["psg"].tolist() == [-7.5, 372.5]
    assert states.angles_deg["psa"].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("head", "scale", "word"),
    [
        ("a,b", 1000, "probably steps of a motor"),
        ("a (mdeg),b (mdeg)", 1, "probably steps"),
        ("a,b\nrad,rad", 1, "radians"),
    ],
)
def test_numbers_that_are_no_degrees_are_refused(drr, lab, tmp_path, process_refuses, head, scale, word):
    table = tmp_path / "log.csv"
    table.write_text(head + "\n" + "".join(f"{12.5 * k * scale},{62.5 * k * scale}\n" for k in range(6)))
    a, b = head.splitlines()[0].split(",")
    options = ("--states", table, "--columns", f"psg={a}", "--columns", f"psa={b}", "--stack", tmp_path / "Läufe")
    assert word in process_refuses("import", *options, *drr)


def test_frames_that_cannot_be_raw_are_refused(drr, tmp_path, process_refuses):
    for k in range(6):
        cv2.imwrite(str(tmp_path / f"G{12.5 * k}_A{62.5 * k}.jpg"), FRAMES[k].astype(np.uint8))
    assert "JPEG changes the grey values" in process_refuses("import", "--stack", tmp_path / "G{psg}_A{psa}.jpg", *drr)


def test_an_array_that_is_not_in_a_file_is_answered_with_those_that_are(drr, tmp_path, process_refuses):
    with h5py.File(tmp_path / "run.h5", "w") as h5:
        h5["scan/frames"], h5["scan/angle"] = FRAMES, ANGLES["psg"]
    np.savez(tmp_path / "run.npz", frames=FRAMES, angle=ANGLES["psg"])
    for file, names in (("run.h5", "/scan/angle, /scan/frames"), ("run.npz", "frames, angle")):
        err = process_refuses("import", "--columns", f"psg={tmp_path / file}::psg", "--stack", tmp_path / file, *drr)
        assert f"it has {names}" in err


def test_an_archive_that_promises_more_than_it_holds_is_refused(drr, tmp_path, process_refuses):
    np.savez(tmp_path / "run.npz", frames=FRAMES)
    data = (tmp_path / "run.npz").read_bytes()
    assert data.count(b"(6, 4, 5)") == 1
    data = data.replace(b"(6, 4, 5), }          ", b"(6, 9999999999, 5), } ")
    (tmp_path / "run.npz").write_bytes(data)
    np.save(tmp_path / "a.npy", ANGLES["psg"])
    axes = ("--columns", f"psg={tmp_path}/a.npy", "--columns", f"psa={tmp_path}/a.npy")
    assert "run.npz" in process_refuses("import", *axes, "--stack", f"{tmp_path}/run.npz::frames", *drr)

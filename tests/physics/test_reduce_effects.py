"""What `diagnose` writes into an instrument file, the next reduction takes out."""

from pathlib import Path

import numpy as np
import pytest
from reduced_capture import reduced

from processing.instrument.applied_effects import changes_at, changes_of, instrument_effects
from processing.instrument.changes import Conditions, field_terms
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.polarization import mueller
from processing.reduction.counts_to_signal import BlockReader, CountCorrection
from processing.reduction.effects_of_capture import CountsCorrection
from processing.reduction.mueller import reduce_mueller
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Step
from processing.yaml_file import dump_yaml

SHAPE = (24, 30)
FULL_SCALE = 4095.0
ANGLES = {"psg": 9.0 * np.arange(40), "psa": 4.91 * 9.0 * np.arange(40)}


def smooth_scene() -> np.ndarray:
    """Mueller image (4, 4, rows, columns) of m00 about 4000 counts that varies slowly."""
    y, x = np.indices(SHAPE) / 12
    level = 4000 * (1 + 0.2 * np.sin(x) * np.cos(y))
    m = 0.6 * mueller.retarder(0.3, 1.1) @ mueller.diattenuator(0.4, 1.0, 0.7) + 0.3 * mueller.IDEAL_DEPOLARIZER
    return m[..., None, None] * level


def effect(kind: str, element: str | None = None, captures: tuple[str, ...] = (), **parameters: float) -> AppliedEffect:
    scope = "capture" if captures else "instrument"
    values = {k: EffectParameter(value=v, unit="1") for k, v in parameters.items()}
    return AppliedEffect(kind=kind, element=element, parameters=values, scope=scope, captures=captures)


def error(image: MuellerImage, truth: np.ndarray) -> float:
    """Largest error of an element over m00, away from the border."""
    inner = np.s_[..., 4:-4, 4:-4]
    return float(np.max(np.abs((image.values - truth)[inner]) / truth[0, 0][inner[1:]]))


def capture_of(write, signal: np.ndarray) -> Path:
    return write(signal, ANGLES, title="test")


@pytest.mark.parametrize(
    ("kind", "element", "parameters"),
    [("psg_azimuth", "psg_retarder", {"error_deg": 1.5}), ("psa_retardance", "psa_retarder", {"error_deg": 3.0})],
)
def test_effects_of_the_optics_go_into_w(
    kind: str, element: str, parameters: dict[str, float], rgb950: InstrumentModel, synthetic_capture
) -> None:
    conditions = Conditions.of(ANGLES)
    names = [p.name for p in instrument_effects()[kind].parameters(rgb950, conditions, element)]
    applied = effect(kind, element, **dict(zip(names, parameters.values(), strict=True)))
    real = rgb950.model_copy(update={"effects": (applied,)})
    truth = smooth_scene()
    signal = np.einsum("nck,kxy->ncxy", real.rows(ANGLES, changes_at(real, ANGLES)), truth.reshape(16, *SHAPE))
    path = capture_of(synthetic_capture, signal)
    assert error(reduced(path, rgb950), truth) > 0.01
    assert error(reduced(path, real), truth) < 1e-5


def test_drift_of_the_source_counts_for_its_capture_alone(rgb950: InstrumentModel, synthetic_capture) -> None:
    conditions = Conditions.of(ANGLES)
    drift = instrument_effects()["source_drift"]
    place = drift.places(rgb950, conditions)[0]
    names = [p.name for p in drift.parameters(rgb950, conditions, place)]
    values = dict.fromkeys(names, 0.0) | {names[0]: 0.08}
    applied = effect("source_drift", place or None, ("test (capture.h5)",), **values)
    real = rgb950.model_copy(update={"effects": (applied,)})
    rows = rgb950.rows(ANGLES, changes_of(real, conditions, "capture"))
    truth = smooth_scene()
    signal = np.einsum("nck,kxy->ncxy", rows, truth.reshape(16, *SHAPE))
    path = capture_of(synthetic_capture, signal)
    plain = error(reduced(path, rgb950), truth)
    assert plain > 0.01
    assert error(reduced(path, real), truth) < 1e-5
    elsewhere = real.model_copy(update={"effects": (applied.model_copy(update={"captures": ("test (b.h5)",)}),)})
    assert error(reduced(path, elsewhere), truth) == pytest.approx(plain, rel=1e-3)


def test_counts_are_corrected(rgb950: InstrumentModel, synthetic_capture) -> None:
    truth = smooth_scene()
    light = np.einsum("nck,kxy->ncxy", rgb950.rows(ANGLES), truth.reshape(16, *SHAPE))
    bent = light * (1 - 0.05 * light / FULL_SCALE) + 12.0
    # Floating frames have no bits: the top of the range is their largest value.
    top = bent.max()
    path = synthetic_capture(bent, ANGLES, title="test")
    real = rgb950.model_copy(
        update={
            "effects": (
                effect("detector_offset", offset=12.0),
                effect("detector_nonlinearity", lost_at_full_scale=0.05 * top / FULL_SCALE),
            )
        }
    )
    assert error(reduced(path, rgb950), truth) > 0.005
    assert error(reduced(path, real), truth) < 5e-4


def test_means_of_counts_have_the_range_of_the_counts(rgb950: InstrumentModel, synthetic_capture) -> None:
    """What was found in whole counts corrects their means, which are floating and fill half of the range."""
    truth = smooth_scene()
    light = np.einsum("nck,kxy->ncxy", rgb950.rows(ANGLES), truth.reshape(16, *SHAPE))
    truth, light = truth * 2000 / light.max(), light * 2000 / light.max()
    bent = (light * (1 - 0.05 * light / 4095)).astype(np.float32)
    path = synthetic_capture(bent, ANGLES, title="test", detector={"bits": 12})
    real = rgb950.model_copy(update={"effects": (effect("detector_nonlinearity", lost_at_full_scale=0.05),)})
    assert error(reduced(path, rgb950), truth) > 0.005
    assert error(reduced(path, real), truth) < 5e-4


def test_light_that_moves_over_the_image_is_levelled(rgb950: InstrumentModel, synthetic_capture) -> None:
    truth = smooth_scene()
    light = np.einsum("nck,kxy->ncxy", rgb950.rows(ANGLES), truth.reshape(16, *SHAPE))
    y, x = (np.linspace(-1, 1, n) for n in SHAPE)
    turn = np.cos(np.deg2rad(ANGLES["psa"]))
    # An image has no zero of its own.
    turn = (turn - turn.mean())[:, None, None, None]
    path = synthetic_capture(light / (1 - turn * (0.02 * x - 0.01 * y[:, None])), ANGLES, title="test")
    sentence = "brightness right and brightness down of image by 1 x psa"
    values = {"brightness_right_cos": 0.02, "brightness_right_sin": 0.0}
    values |= {"brightness_down_cos": -0.01, "brightness_down_sin": 0.0}
    real = rgb950.model_copy(update={"effects": (effect("unlisted", sentence, **values),)})
    assert error(reduced(path, rgb950), truth) > 0.005
    assert error(reduced(path, real), truth) < 2e-5


def test_a_moving_image_is_moved_back(rgb950: InstrumentModel, synthetic_capture) -> None:
    truth = smooth_scene()
    elapsed = np.linspace(0.0, 1.0, 40)
    w = rgb950.rows(ANGLES)
    y, x = np.indices(SHAPE).astype(float)
    frames = np.empty((40, 1, *SHAPE))
    for n in range(40):
        # The scene stands 1.6 pixels further right and 0.8 further up at the end than at the start, where M holds.
        yy, xx = (y + 0.8 * elapsed[n]) / 12, (x - 1.6 * elapsed[n]) / 12
        level = 4000 * (1 + 0.2 * np.sin(xx) * np.cos(yy))
        frames[n, 0] = level * (w[n, 0] @ (truth / truth[0, 0]).reshape(16, *SHAPE)[:, 0, 0]) * truth[0, 0, 0, 0] / 4000
    scale = truth[0, 0, 0, 0] / 4000
    path = synthetic_capture(frames, ANGLES, title="test")
    applied = effect("image_drift", None, ("test (capture.h5)",), x=1.6, y=-0.8)
    real = rgb950.model_copy(update={"effects": (applied,)})
    level = 4000 * (1 + 0.2 * np.sin(x / 12) * np.cos(y / 12))
    expected = (truth / truth[0, 0])[..., 0, 0][..., None, None] * level * scale
    before, after = error(reduced(path, rgb950), expected), error(reduced(path, real), expected)
    assert before > 0.004
    assert after < before / 5


def test_pixels_of_a_mosaic_are_moved_among_their_own_kind(synthetic_capture) -> None:
    y, x = np.indices((32, 40)).astype(float)
    levels = np.array([[1.0, 0.1], [0.4, 3.0]])[np.arange(32)[:, None] % 2, np.arange(40) % 2]
    shift = np.array([[0.0, 0.0], [1.4, -0.6]])
    frames = np.stack([levels * (2000 + 500 * np.sin((x - a) / 7) * np.cos((y - b) / 9)) for a, b in shift])
    path = synthetic_capture(frames[:, None], {"psg": np.zeros(2), "psa": np.zeros(2)}, title="test")
    with Capture(path) as capture:
        correction, states = CountCorrection.of(capture), np.arange(2)

        def off(pitch: int) -> float:
            counts = CountsCorrection(1.0, {}, shift, pitch)
            # In blocks of rows, the second one in the middle of a pair.
            first, second = (
                BlockReader(capture, states, correction, counts).read(rows).copy()
                for rows in (slice(0, 15), slice(15, 32))
            )
            moved = np.concatenate([first, second], axis=2).reshape(2, 32, 40)
            return float(np.max(np.abs(moved[1] / moved[0] - 1)[6:-6, 6:-6]))

        assert off(2) < 2e-3
        assert off(1) > 0.1


def test_super_pixels_behind_a_plate_that_moves_the_image_are_moved_back(synthetic_capture, configs: Path) -> None:
    """Each kind of pixel is an image of its own there already; it was taken apart once more, and moved twice as far."""
    model = InstrumentModel.load(configs / "instruments/polarization_camera_retarder.yaml")
    y, x = np.indices((64, 80)).astype(float)
    levels = np.array([[1.0, 0.1], [0.4, 3.0]])[np.arange(64)[:, None] % 2, np.arange(80) % 2]
    shift = np.array([[0.0, 0.0], [1.4, -0.6], [-0.8, 2.6]])
    frames = np.stack([levels * (2000 + 500 * np.sin((x - a) / 7) * np.cos((y - b) / 9)) for a, b in shift])
    path = synthetic_capture(
        frames[:, None], {"psa": np.zeros(3)}, mosaic=model.mosaic, instrument_yaml=dump_yaml(model)
    )
    with Capture(path, by_super_pixel=True) as capture:
        counts = CountsCorrection(1.0, {}, shift, model.pitch)
        reader = BlockReader(capture, np.arange(3), CountCorrection.of(capture), counts)
        moved = np.concatenate([reader.read(rows).copy() for rows in (slice(0, 15), slice(15, 32))], axis=2)
    images = moved.reshape(3, 4, 32, 40)
    for image in images[1:]:
        assert np.max(np.abs(image / images[0] - 1)[:, 6:-6, 6:-6]) < 2e-3


def test_retardance_that_varies_over_the_image(rgb950: InstrumentModel, synthetic_capture) -> None:
    applied = effect("field_retardance", "psa_retarder", x=4.0, y=-2.0, x2=3.0, xy=1.0, y2=0.0)
    real = rgb950.model_copy(update={"effects": (applied,)})
    truth = smooth_scene()
    y, x = np.meshgrid(np.linspace(-1, 1, SHAPE[0]), np.linspace(-1, 1, SHAPE[1]), indexing="ij")
    extra = np.tensordot([4.0, -2.0, 3.0, 1.0, 0.0], field_terms(x, y), axes=1)
    frames = np.empty((40, 1, *SHAPE))
    for r in range(SHAPE[0]):
        for c in range(SHAPE[1]):
            retarder = rgb950.analyzer[0].model_copy(update={"retardance_deg": 94.78 + extra[r, c]})
            pixel = rgb950.model_copy(update={"analyzer": (retarder, rgb950.analyzer[1])})
            frames[:, 0, r, c] = pixel.rows(ANGLES)[:, 0] @ truth[..., r, c].reshape(16)
    path = synthetic_capture(frames, ANGLES, title="test")
    assert error(reduced(path, rgb950), truth) > 0.02
    image = reduced(path, real)
    assert error(image, truth) < 2e-4
    assert np.nanmax(image.residual_rms) < 0.5


def test_air_states_are_not_mixed_with_the_sample(rgb950: InstrumentModel, synthetic_capture) -> None:
    truth = smooth_scene()
    signal = np.einsum("nck,kxy->ncxy", rgb950.rows(ANGLES), truth.reshape(16, *SHAPE))
    frames = np.concatenate([signal[:5] * 3, signal])
    angles = {axis: np.concatenate([v[:5], v]) for axis, v in ANGLES.items()}
    path = synthetic_capture(frames, angles, role=("air",) * 5 + ("sample",) * 40)
    image = reduced(path, rgb950)
    assert image.facts["states"] == 40
    assert error(image, truth) < 1e-5


def test_the_product_says_at_which_moment_it_holds(rgb950, synthetic_capture):
    rows = rgb950.rows(ANGLES).reshape(-1, 16)
    signal = np.tensordot(rows, smooth_scene().reshape(16, *SHAPE), axes=1)[:, None]
    path = capture_of(synthetic_capture, signal)
    out = path.with_suffix(".product.h5")
    with Capture(path) as capture:
        drift = (
            effect("image_drift", captures=(capture.name,), x=1.0, y=0.5),
            effect("image_drift", captures=("b",), x=9.0, y=0),
        )
        facts = reduce_mueller(
            capture, rgb950.model_copy(update={"effects": drift[:1]}), out, (Step("reduce", {}),), overwrite=True
        )
        assert "in the first state (image_drift)" in facts["reference"]
        facts = reduce_mueller(
            capture, rgb950.model_copy(update={"effects": drift[1:]}), out, (Step("reduce", {}),), overwrite=True
        )
        assert "reference" not in facts

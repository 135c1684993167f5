"""What `diagnose` says, as it is written to JSON."""

from __future__ import annotations

import math
from typing import Literal

from processing.diagnosis.search.rules import CHANCE_WORSE, FAR_OFF, LEAST_CHANGE
from processing.instrument.model import AppliedEffect, EffectParameter, SystematicError
from processing.section import Section

Verdict = Literal["consistent", "explained", "partly_explained", "unexplained", "undetermined"]


class BeyondNoise(Section):
    """The part of a residual that noise does not explain: rms of it, percent of the mean signal.

    Residual, noise and error have one unit: that of the counts as they were taken, whatever is corrected.

    Attributes
    ----------
    percent : zero where the residual is not larger than noise.
    stderr : standard error; most : two standard errors of the mean square above it.
    mean_square : in percent squared, below zero where noise makes it so.
    stderr_of_known : standard error of the rms of a pattern whose shape is known. It is far smaller than `stderr` of
        a small residual.
    """

    percent: float
    stderr: float
    most: float
    mean_square: float
    stderr_of_known: float

    @classmethod
    def of(cls, excess: float, freedom: float, noise_percent: float) -> BeyondNoise:
        """Of a chi-square that is larger than its `freedom` by `excess`, and of the rms noise of one intensity.

        Examples
        --------
        >>> BeyondNoise.of(excess=18_000, freedom=1_000_000, noise_percent=1.25).text
        '0.168 ± 0.007 %'
        >>> BeyondNoise.of(excess=900, freedom=1_000_000, noise_percent=1.25).text
        'under 0.08 %'
        """
        share, error = max(excess / freedom, 0.0), (2 / freedom) ** 0.5
        return cls(
            mean_square=noise_percent**2 * excess / freedom,
            stderr_of_known=noise_percent / freedom**0.5,
            percent=noise_percent * share**0.5,
            stderr=noise_percent * error / 2 / max(share, error) ** 0.5,
            most=noise_percent * (share + 2 * error) ** 0.5,
        )

    @property
    def text(self) -> str:
        """With its error, or below which it is where noise alone could be as large."""
        return _percent(self.percent, self.stderr) if self.resolved else f"under {self.most:.1g} %"

    @property
    def resolved(self) -> bool:
        """The residual is larger than noise alone could make it."""
        return 2 * self.percent**2 >= self.most**2

    def explained(self, after: BeyondNoise) -> str | None:
        """How much a correction explains that leaves `after`; None where that is nothing.

        Examples
        --------
        >>> before, after = (BeyondNoise.of(x, freedom=1_000_000, noise_percent=2.5) for x in (2000, -100))
        >>> before.text, before.explained(after)
        ('under 0.2 %', '0.115 ± 0.003 %')
        """
        square = self.mean_square - after.mean_square
        return _percent(square**0.5, self.stderr_of_known) if square > self.stderr_of_known**2 else None


def _percent(value: float, stderr: float) -> str:
    digits = max(0, 2 - math.floor(math.log10(value)))
    error = f"{stderr:.{digits}f}"
    return f"{value:.{digits}f}" + (f" ± {error} %" if float(error) > 0 else " %")


class Error(Section):
    """Residual on data that the fit has not seen, for each degree of freedom; `held_out` says which data.

    `beyond_noise`: what of it noise does not explain; None where the noise is not known.
    """

    rms_percent: float
    chi2_reduced: float
    held_out: str
    beyond_noise: BeyondNoise | None = None

    @property
    def text(self) -> str:
        """The residual beyond noise, or all of it where the noise is not known."""
        return f"{self.rms_percent:.3g} %" if self.beyond_noise is None else self.beyond_noise.text

    def explained(self, after: Error) -> str | None:
        """What a correction explains that leaves `after`, where this residual is lost in noise; otherwise None."""
        if after == self or self.beyond_noise is None or after.beyond_noise is None or self.beyond_noise.resolved:
            return None
        return self.beyond_noise.explained(after.beyond_noise)

    def text_change(self, after: Error) -> str:
        """This residual and the one `after` a correction, or how much of this one is explained."""
        if after == self:
            return self.text
        explained = self.explained(after)
        return f"{self.text} -> {after.text}" if explained is None else f"{self.text} ({explained} explained)"


class FoundEffect(Section):
    """One effect with its values, the chi-square it explains on held-out data, and what else it could be.

    `probability` is that of this cause or one of those that it cannot be told from; `answer` says it in a word (sure,
    likely, one of, unknown). `confident` is False where the name may be wrong. `residual_without` is that of the
    correction without this effect, `residual_with` that of all of it; `not_applied` says why it is in no correction.
    """

    kind: str
    element: str | None
    parameters: dict[str, EffectParameter]
    evidence: float
    indistinguishable_from: tuple[str, ...]
    scope: Literal["instrument", "capture"]
    capture: str | None = None
    wavelength_nm: float | None = None
    removal_chance: float
    confident: bool
    probability: float | None = None
    answer: str | None = None
    residual_without: Error | None = None
    residual_with: Error | None = None
    not_applied: str | None = None

    @property
    def could_be(self) -> tuple[str, ...]:
        """What it cannot be told from, with an effect from one state on or another once."""
        states: dict[str, list[int]] = {}
        for name in self.indistinguishable_from:
            short, at, state = name.rstrip("]").rpartition("@")
            states.setdefault(f"{short}]" if at else name, []).extend([int(state)] if at else [])
        return tuple(
            f"{name} from one of the states {min(n)} to {max(n)}"
            if len(n) > 1
            else f"{name[:-1]}@{n[0]}]"
            if n
            else name
            for name, n in states.items()
        )


class Ranked(Section):
    """What a candidate would do alone, in the data that it is fitted to.

    Attributes
    ----------
    evidence : chi-square that it gains. Chance alone gains one for each of its `values` (None in older files).
    rms_percent : residual that it would leave, percent of the mean signal.
    """

    candidate: str
    evidence: float
    rms_percent: float
    values: int | None = None


class Unexplained(Section, extra="ignore"):
    """What is left over, in words, and what was tried; a result of version 0.2.0 has an empirical correction too."""

    description: tuple[str, ...]
    tried: tuple[str, ...]


class Check(Section):
    """One figure of the guard: it must not get worse by a correction."""

    name: str
    before: float
    after: float
    holds: bool
    is_chance: bool = False

    @property
    def text(self) -> str:
        """Why it refuses a correction."""
        if self.is_chance:
            return f"{self.name}: {100 * self.after:.2g} %, where {100 * CHANCE_WORSE:g} % is the limit"
        return f"{self.name}, from {self.before:.4g} to {self.after:.4g}"

    @property
    def shown(self) -> tuple[str, str]:
        """The figures before and after; a chance has its limit instead of a value before."""
        if self.is_chance:
            return f"limit {100 * CHANCE_WORSE:g} %", f"{100 * self.after:.2g} %"
        return f"{self.before:.4g}", f"{self.after:.4g}"


class Combination(Section):
    """Values that are known together: sum of weight times value; `open_by` moves each of them and is not determined.

    The weight of the value whose unit it has is one.
    """

    weights: dict[str, float]
    value: float
    stderr: float
    unit: str
    open_by: dict[str, float]


def _not_less(size: float) -> str:
    """An error of M/m00 in words; one that the rounding of counts makes alone is no figure."""
    return f"{size:.2g}" if size > LEAST_CHANGE else f"less than {LEAST_CHANGE:g}"


class MuellerError(Section):
    """How wrong M/m00 of these captures may still be, whatever the noise, with the instrument that would be written.

    Attributes
    ----------
    elements : standard errors of the 16 elements, row by row, rms over the pixels; rms : over 15 of them.
    most : the effect that the largest owes most to.
    """

    elements: tuple[float, ...]
    rms: float
    most: str

    @property
    def text(self) -> str:
        """In words."""
        largest = max(range(len(self.elements)), key=lambda k: self.elements[k])
        row, column = divmod(largest, 4)
        return (
            f"M/m00 may still be off by {_not_less(self.rms)} (rms of its elements), most in M{row}{column} by "
            f"{_not_less(self.elements[largest])}, where {self.most} counts most"
        )


class Correction(Section):
    """What would be written: means of the posterior, apart from names, and whether it may be used.

    Attributes
    ----------
    effects : as an instrument file stores them, with their standard errors.
    systematic : what stays uncertain, as a Mueller matrix notices it; `mueller` tells it.
    combinations : what is determined of values that are not determined one by one.
    checks : figures before and after; one that gets worse refuses the correction.
    refused : why nothing is written; None if the correction holds.
    """

    effects: tuple[AppliedEffect, ...]
    systematic: SystematicError | None = None
    mueller: MuellerError | None = None
    combinations: tuple[Combination, ...] = ()
    checks: tuple[Check, ...] = ()
    refused: str | None = None


class CaptureReport(Section):
    """One capture: what is known of it, and how far its residual is from noise, before and after.

    `error_before`, `error_after`: on held-out data, of this capture alone. `evidence`: what speaks against its frames,
    in sentences.
    """

    name: str
    sample: str
    simulated: bool
    noise: str
    evidence: tuple[str, ...] = ()
    binned: int
    clipped_fraction: float
    dark_fraction: float = 0.0
    steep_fraction: float = 0.0
    cut_off: tuple[int, ...] = ()
    source_percent: float | None = None
    tests_before: dict[str, float]
    tests_after: dict[str, float]
    wavelength_nm: float | None = None
    error_before: Error | None = None
    error_after: Error | None = None
    closure_before_percent: float | None = None
    closure_after_percent: float | None = None


class NotMeasured(Section):
    """What of a capture is no measurement of the sample, and was left out.

    Attributes
    ----------
    states : numbers among the states of the sample; misfits_percent : by how much each differs from what the others
        predict, rms, relative to the signal; exchanged : those that are in each other's place.
    hits : state, channel, row and column of single intensities that were struck (cosmic rays, bit errors).
    pixels : row and column of bad pixels. All are of the frames as stored, each the first of `pitch` x `pitch` pixels.
    """

    capture: str
    states: tuple[int, ...] = ()
    misfits_percent: tuple[float, ...] = ()
    exchanged: tuple[int, ...] = ()
    hits: tuple[tuple[int, int, int, int], ...] = ()
    pixels: tuple[tuple[int, int], ...] = ()
    pitch: int = 1

    @property
    def text(self) -> str:
        """In words."""
        parts = []
        if self.states:
            misfits = ", ".join(f"{k} ({m:.0f} % off)" for k, m in zip(self.states, self.misfits_percent, strict=True))
            why = "each in the other's place" if self.exchanged else "which the others do not predict"
            parts.append(f"state{'s' if len(self.states) > 1 else ''} {misfits}, {why}")
        if self.hits:
            struck = len({h[2:] for h in self.hits})
            parts.append(f"{len(self.hits)} hits (as of cosmic rays) in {struck} pixels")
        if self.pixels:
            parts.append(f"{len(self.pixels)} bad pixel{'s' if len(self.pixels) > 1 else ''}")
        return "; ".join(parts)


class NoiseReport(Section):
    """What the noise is, and how it differs from what is declared, for each capture that it differs in."""

    verdict: Literal["as_declared", "not_as_declared", "estimated", "unknown"]
    told: tuple[str, ...] = ()


class Diagnosis(Section):
    """Result of `diagnose`."""

    verdict: Verdict
    error_before: Error
    error_after: Error
    noise_floor_percent: float | None
    effects: tuple[FoundEffect, ...]
    unobservable: tuple[str, ...]
    recommendation: str
    unexplained: Unexplained | None
    calibrated: dict[str, EffectParameter]
    ranking: tuple[Ranked, ...]
    captures: tuple[CaptureReport, ...]
    instrument: str
    wavelengths_nm: tuple[float, ...]
    simulated: bool
    correction: Correction | None = None
    wiring: str | None = None
    branch: str | None = None
    left_out: tuple[NotMeasured, ...] = ()
    noise: NoiseReport | None = None

    def applied(self) -> tuple[AppliedEffect, ...]:
        """The effects as an instrument file stores them; none where the correction does not hold."""
        if self.correction is None or self.correction.refused is not None:
            return ()
        return self.correction.effects

    @property
    def unobservable_in_short(self) -> tuple[str, ...]:
        """The listed effects that these captures cannot show, and the number of the unlisted ones."""
        listed = tuple(name for name in self.unobservable if not name.startswith("unlisted"))
        unlisted = len(self.unobservable) - len(listed)
        return (*listed, *([f"{unlisted} effects without a name"] if unlisted else ()))

    @property
    def corrects(self) -> bool:
        """Whether an instrument file would measure otherwise with what was found."""
        return bool(self.applied() or (self.calibrated and self.train_fits))

    @property
    def train_fits(self) -> bool:
        """Whether the nominal values are fitted, so that they are used also where effects beside them are refused."""
        fits = self.wiring is None and self.error_before.rms_percent < 100 * FAR_OFF
        return fits or self.correction is None or self.correction.refused is None

    def systematic(self) -> tuple[SystematicError, ...]:
        """What an instrument file stores of the uncertainty, also where nothing is corrected; wiring comes first."""
        error = self.correction.systematic if self.correction is not None else None
        return () if error is None or self.wiring is not None else (error,)

"""The result of the demo in words: built-in faults with the effects found, and the figures before and after."""

from acquisition.demo.loop import Demo
from processing.diagnosis.search.result import FoundEffect

#: Values of one effect that fit on a line.
MOST_VALUES = 2
NOT_FOUND = "not found"


def cause_rows(demo: Demo) -> list[tuple[str, str]]:
    """Each built-in fault with the effect found for it, then the effects found for none of them."""
    rows, matched = [], list[FoundEffect]()
    for fault in demo.faults:
        effects = demo.effects_for(fault)
        matched += effects
        rows.append((f"{fault.kind}: {fault.size}", effect_line(effects[0]) if effects else NOT_FOUND))
    unmatched = [e for e in demo.judged.diagnosis.effects if not any(e is m for m in matched)]
    return rows + [("nothing", effect_line(e)) for e in unmatched]


def effect_line(effect: FoundEffect) -> str:
    """Kind, values with their errors, and how sure the name is."""
    values, units = zip(*((p.text, p.unit) for p in effect.parameters.values()), strict=True)
    text = ", ".join(values[:MOST_VALUES]) + (", ..." if len(values) > MOST_VALUES else "")
    text += "" if units[0] == "1" else f" {units[0]}"
    equal = len({name.partition("[")[0] for name in effect.indistinguishable_from} - {effect.kind})
    sure = effect.answer if effect.confident and effect.answer else "uncertain"
    return f"{effect.kind}: {text} ({f'one of {equal + 1} equal names' if equal else sure})"


def figure_rows(demo: Demo) -> list[tuple[str, str, str, str]]:
    """Name, value before, value after, and what photon noise alone gives."""
    d, before, after = demo.judged.diagnosis, demo.before, demo.after
    return [
        ("residual beyond noise", d.error_before.text, d.error_after.text, ""),
        ("error of M/m00", f"{before.mueller_rms:.4f}", f"{after.mueller_rms:.4f}", f"{after.mueller_noise:.4f}"),
        ("error of xi0", f"{before.xi0_rms:.4f}", f"{after.xi0_rms:.4f}", f"{after.xi0_noise:.4f}"),
    ]

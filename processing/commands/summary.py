"""The text that a command prints about its product."""

from pathlib import Path
from typing import Any

import typer

from processing.reports.fact_words import fact_lines, fact_words

#: Endings of the names of facts that are standard errors of other facts.
ERRORS = ("_error", "_stderr")


def summary(product: Path) -> None:
    """Print facts, warnings (stderr) and the name of a product file."""
    from processing.storage.products.product import Product

    with Product(product) as opened:
        facts, simulated = opened.facts, opened.simulated
    if simulated:
        typer.echo("SIMULATED data")
    for name, (label, words) in fact_lines(facts).items():
        if name not in ("warnings", "masked") and not name.endswith(ERRORS):
            typer.echo(f"  {label}: {words}{_with_error(name, facts)}")
    print_warnings(product)
    typer.echo(str(product))


def print_warnings(product: Path, head: str = "") -> None:
    """Print the warnings of a product on stderr, each after `head`."""
    from processing.storage.products.product import Product

    with Product(product) as opened:
        for warning in opened.facts["warnings"]:
            typer.echo(f"warning: {head}{warning}", err=True)


def one_line(product: Path) -> str:
    """The text after the name of a product in a batch: whether it is simulated, and its first median."""
    from processing.storage.products.product import Product

    with Product(product) as opened:
        facts, simulated = opened.facts, opened.simulated
    medians = [name for name in facts if name.startswith("median") and not name.endswith(ERRORS)]
    # The fit comes first: it says whether the model holds.
    medians.sort(key=lambda name: "chi_square" not in name)
    shown = [f"{name.replace('_', ' ')} {fact_words(facts[name])}" for name in medians[:1]]
    return "".join(f"  {text}" for text in ["SIMULATED"] * simulated + shown)


def _with_error(name: str, facts: dict[str, Any]) -> str:
    """Standard error of a fact, in the same line: of one pixel for a median over pixels, else of the number."""
    base = name.removesuffix("_e_per_count").removesuffix("_e")
    for ending in ERRORS:
        error = facts.get(f"{name}{ending}", facts.get(f"{base}{ending}"))
        if error is not None:
            text = "unknown" if error != error else f"{error:.2g}"
            return f" (standard error of a pixel {text})" if name.startswith("median") else f" +- {text}"
    return ""

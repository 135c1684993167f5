"""Check the language of README, CONTRIBUTING, CHANGELOG and docs/: `./lab check` runs it.

A sentence has at most 30 words, a page under 18 on average, a line of prose at most 120 characters. No page uses a word
of `IDIOM`. The first paragraph of a page in docs/ begins with its purpose, such as "Reference." An explanation has at
most 2,500 words, docs/ without docs/studies/ at most 40,000. Code, tables and headings are not read.
"""

import re
import sys
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parents[1]
LONGEST_SENTENCE, MEAN_SENTENCE, LONGEST_LINE, EXPLANATION, TOTAL = 30, 18, 120, 2500, 40_000
PURPOSE = re.compile(r"^(Tutorial|How-to|Reference|Explanation|Study)\.")
#: Words that are neither names nor terms. "the left" and "left-aligned" are directions.
IDIOM = re.compile(
    r"\b(told|tells?|(?<!the )left(?!-)|beside|in (its|their) place|what is there|as much does so"
    r"|(go|goes|gone|going) on with|held against|it (knows|doubts|says))\b",
    re.IGNORECASE,
)


def read(text: str) -> tuple[list[str], list[int]]:
    """Return the sentences of a page and the numbers of its lines of prose."""
    sentences, lines, in_table, in_heading = [], [], False, False
    for token in MarkdownIt().enable("table").parse(text):
        in_table = token.type != "table_close" and (in_table or token.type == "table_open")
        in_heading = token.type == "heading_open"
        if token.type != "inline" or in_table or in_heading or token.content.startswith(":::"):
            continue
        if token.map and text.splitlines()[token.map[0]].startswith("#"):
            continue
        lines += range(token.map[0], token.map[1]) if token.map else []
        parts = [
            {"text": part.content, "code_inline": " Code ", "softbreak": " "}.get(part.type, "")
            for part in token.children or []
        ]
        sentences += re.split(r"(?<=[.!?])[)\"]?\s+(?=[^a-z])", "".join(parts).strip())
    return [s for s in sentences if re.search(r"\w", s)], lines


def words(text: str) -> int:
    """Count words; signs alone are none."""
    return sum(bool(re.search(r"\w", word)) for word in text.split())


def mistakes(name: str, text: str) -> list[str]:
    """Return what a page does against the rules."""
    sentences, lines = read(text)
    purpose = PURPOSE.match(sentences[0]) if sentences else None
    sentences = [s for sentence in sentences if (s := PURPOSE.sub("", sentence))]
    lengths = [words(sentence) for sentence in sentences]
    found = [f"{n} words: {s}" for s in sentences if (n := words(s)) > LONGEST_SENTENCE]
    if lengths and sum(lengths) / len(lengths) >= MEAN_SENTENCE:
        found.append(f"mean length of a sentence is {sum(lengths) / len(lengths):.1f} words")
    found += [f"line {i + 1} is longer than {LONGEST_LINE}" for i in lines if len(text.splitlines()[i]) > LONGEST_LINE]
    found += [f'"{hit[0]}" in: {s}' for s in sentences if (hit := IDIOM.search(s))]
    if name.startswith("docs/") and name != "docs/index.md":
        if not purpose:
            found.append("the first paragraph does not begin with a purpose, such as *Reference.*")
        elif purpose[1] == "Explanation" and len(text.split()) > EXPLANATION:
            found.append(f"an explanation of {len(text.split())} words")
    return [f"{name}: {mistake}" for mistake in found]


def main() -> None:
    """Check every page, or show what pages named on the command line do against the rules."""
    files = [*(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")), *(ROOT / "docs").rglob("*.md")]
    pages = {str(file.relative_to(ROOT)): file.read_text(encoding="utf-8") for file in sorted(files)}
    named = [name for name in sys.argv[1:] if name in pages]
    found = [mistake for name in named or pages for mistake in mistakes(name, pages[name])]
    total = sum(len(text.split()) for name, text in pages.items() if re.fullmatch(r"docs/[^/]+", name))
    if total > TOTAL and not named:
        found.append(f"docs/ without studies has {total} words, more than {TOTAL}")
    if found:
        raise SystemExit("\n".join(found))


if __name__ == "__main__":
    main()

"""Hook of mkdocs: each notebook of examples/, with the outputs that it holds, becomes a page."""

import json
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def _output(output: dict[str, Any]) -> str:
    """Return an output as Markdown: a picture, or text."""
    data = output.get("data", {})
    if "image/png" in data:
        return f"![output](data:image/png;base64,{data['image/png'].strip()})"
    return "```text\n" + "".join(output.get("text") or data["text/plain"]).rstrip() + "\n```"


def _page(notebook: Path) -> str:
    parts = []
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        parts += map(_output, cell.get("outputs", []))
    return "\n\n".join([*parts, f"This is `examples/{notebook.name}`.\n"])


def on_files(files: Any, config: Any) -> Any:
    """Add the pages."""
    for notebook in sorted(EXAMPLES.glob("*.ipynb")):
        files.append(File.generated(config, f"notebook-{notebook.stem}.md", content=_page(notebook)))
    return files

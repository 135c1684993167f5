"""Messages of a run, for its closing record."""

import time
from dataclasses import dataclass, field


@dataclass
class Messages:
    """Messages for the closing record; the first 200 are kept."""

    texts: list[str] = field(default_factory=list)
    dropped: int = 0

    def add(self, text: str) -> None:
        """Note a message with its time."""
        if len(self.texts) < 200:
            self.texts.append(f"{time.strftime('%H:%M:%S')} {text[:500]}")
        else:
            self.dropped += 1

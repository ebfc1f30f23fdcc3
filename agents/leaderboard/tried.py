"""What was tried where learned policies are not ahead: printed below the leaderboard's open comparisons."""

from __future__ import annotations

TRIED: dict[str, str] = {}
"""By environment id."""

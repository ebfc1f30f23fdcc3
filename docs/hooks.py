"""What the documentation site is built with besides its pages: equations as MathML, pages that stand in the root.

MkDocs calls these functions (`hooks` in mkdocs.yml). Nothing is downloaded and no script runs in the reader's browser:
a fence ``math``, and what stands between two dollars, is LaTeX, which GitHub renders as it is and the site as MathML.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from markdown import Extension
from markdown.inlinepatterns import InlineProcessor
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
FROM_ROOT = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}
"""Pages of the site and the files of the repository's root that they show."""


def on_config(config: Any) -> Any:
    """Teach fences and lines LaTeX."""
    config.markdown_extensions.append(InlineMath())
    settings = config.mdx_configs.setdefault("pymdownx.superfences", {})
    settings["custom_fences"] = [{"name": "math", "class": "math", "format": math_fence}]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the root's pages; what they link to in docs/ stands beside them here."""
    for page, source in FROM_ROOT.items():
        text = (ROOT / source).read_text(encoding="utf-8").replace("](docs/", "](")
        files.append(File.generated(config, page, content=text))
    return files


def math_fence(source: str, language: str, css_class: str, options: Any, md: Any, **more: Any) -> str:
    """A fence of LaTeX as MathML, one block per line of it; lines that end in a comma or = go on."""
    lines = re.sub(r"([,=\\])\n", r"\1 ", source.strip()).splitlines()
    return f'<div class="{css_class}">' + "".join(convert(line, display="block") for line in lines) + "</div>"


class InlineMath(Extension):
    """Markdown in which $…$ is LaTeX."""

    def extendMarkdown(self, md: Any) -> None:
        """Before backslashes are taken for escapes, after code has been set aside."""
        md.inlinePatterns.register(InlineMathProcessor(r"\$([^$\n]+)\$", md), "math", 185)


class InlineMathProcessor(InlineProcessor):
    """Puts MathML in the place of one $…$."""

    def handleMatch(self, m: re.Match[str], data: str) -> tuple[str, int, int]:
        """The stored MathML and where the match begins and ends."""
        return self.md.htmlStash.store(convert(m[1])), m.start(0), m.end(0)

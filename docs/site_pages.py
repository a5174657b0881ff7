"""Hooks of the documentation site: pages made from files at the top of the repository, examples and public names.

These files stay at the top of the repository. On the site their links are relative to `docs`.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

#: Pages of the site that are files at the top of the repository.
TOP_FILES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
#: Packages whose public names have a reference page.
PACKAGES = ("tissue_sim", "calibration", "haptics", "scenes")
#: A public name in an `__init__.pyi`: module and name.
_PUBLIC_NAME = re.compile(r"^from (\S+) import (\w+) as \2$", re.M)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are not files in `docs`."""
    root = Path(config.config_file_path).parent
    for name, page in TOP_FILES.items():
        files.append(File.generated(config, page, content=_links_from_docs((root / name).read_text(encoding="utf-8"))))
    files.append(File.generated(config, "gallery.md", content=_gallery(root)))
    for package in PACKAGES:
        files.append(File.generated(config, f"api/{package}.md", content=_reference(root, package)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Let links from `docs` to the files at the top of the repository lead to their pages."""
    for name, page in TOP_FILES.items():
        markdown = markdown.replace(f"](../{name}", f"]({page}")
    return markdown


def _links_from_docs(text: str) -> str:
    """Make the links of a file at the top of the repository relative to `docs`."""
    for name, page in TOP_FILES.items():
        text = text.replace(f"]({name}", f"]({page}")
    text = text.replace("[Apache-2.0](LICENSE)", "Apache-2.0").replace("](examples)", "](gallery.md)")
    return re.sub(r"\]\(docs/", "](", text)


def _gallery(root: Path) -> str:
    """Write the gallery: title, mathematics, picture and source of each example."""
    lines = ["# Examples", "", "Each script of `examples` checks one physical number and draws one picture.",
             "The notebook `examples/study.ipynb` imports, calibrates, diagnoses and simulates one specimen.", ""]
    for path in sorted((root / "examples").glob("*.py")):
        source = path.read_text(encoding="utf-8")
        title, _, text = (ast.get_docstring(ast.parse(source)) or path.stem).partition("\n")
        code = [f"    {line}" for line in ("```python", *source.splitlines(), "```")]
        lines += [f"## {title.rstrip('.')}", "", text.strip(), "", f"![{title}](pictures/examples/{path.stem}.png)",
                  "", f'??? example "{path.name}"', "", *code, ""]
    return "\n".join(lines)


def _reference(root: Path, package: str) -> str:
    """Write the reference page of a package: its public names, grouped by subpackage."""
    groups: dict[str, list[str]] = {}
    for module, name in _PUBLIC_NAME.findall((root / package / "__init__.pyi").read_text(encoding="utf-8")):
        parts = module.split(".")
        groups.setdefault(parts[1] if len(parts) > 2 else package, []).append(f"{module}.{name}")
    lines = [f"# {package}", "", f"Public names of `{package}`. `import {package}` imports each name on first use.", ""]
    for group, names in groups.items():
        lines += [f"## {group.replace('_', ' ')}", "", *(f"::: {name}\n" for name in sorted(names)), ""]
    return "\n".join(lines)

"""Other distributions that install modules named `trackers` or `agents`: found out at import, with name and cure."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
IMPORT = "import warnings; warnings.simplefilter('always'); import passive_env; print(passive_env.__version__)"
TOP_LEVEL = ("trackers", "passive_env", "agents")
RIVALS = [("trackers", "trackers"), ("agents", "openai-agents"), ("agents", "agents")]


def install(folder: Path, module: str | None, distribution: str, source: str = '"""Somebody else\'s."""\n') -> Path:
    """What pip would leave in site-packages: a package and its .dist-info (or the .dist-info alone)."""
    folder.mkdir(parents=True, exist_ok=True)
    if module is not None:
        (folder / module).mkdir()
        (folder / module / "__init__.py").write_text(source)
    info = folder / f"{distribution.replace('-', '_')}-1.2.3.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.2.3\n")
    (info / "RECORD").write_text(f"{module}/__init__.py,,\n")
    (info / "top_level.txt").write_text(f"{module or distribution.replace('-', '_')}\n")
    return folder


def run(*first_on_path: Path, code: str = IMPORT, last_on_path: Path | None = None) -> subprocess.CompletedProcess:
    """Run code in a fresh interpreter with folders before (and one behind) this project on its path."""
    paths = [*map(str, first_on_path), str(ROOT), *([str(last_on_path)] if last_on_path else [])]
    code = f"import sys; sys.path[:0] = {paths!r}\n{code}"
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False, cwd="/"
    )


def test_alone_it_imports_in_silence():
    done = run()
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "0.1.0"
    assert done.stderr == ""


@pytest.mark.parametrize(("module", "distribution"), RIVALS)
def test_a_rival_in_front_stops_the_import_with_its_name_and_the_cure(tmp_path, module, distribution):
    done = run(install(tmp_path / "site", module, distribution))
    assert done.returncode != 0
    message = done.stderr.strip().splitlines()[-1]
    assert message.startswith("ImportError: ")
    for words in (f"'{module}'", distribution, "python -m venv", "pip install passive-env"):
        assert words in message


@pytest.mark.parametrize(("module", "distribution"), RIVALS)
def test_a_rival_behind_is_a_warning_that_names_it_and_the_cure(tmp_path, module, distribution):
    """Ours is intact, but the next upgrade of either may overwrite the other."""
    done = run(last_on_path=install(tmp_path / "site", module, distribution))
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "0.1.0"
    assert "RuntimeWarning" in done.stderr
    for words in (f"'{module}'", distribution, "python -m venv"):
        assert words in done.stderr


def test_the_warning_points_at_the_users_import(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text("import passive_env\n")
    site = install(tmp_path / "site", "trackers", "trackers")
    code = f"sys.path.append({str(tmp_path)!r}); import warnings; warnings.simplefilter('always'); import mine"
    done = run(last_on_path=site, code=code)
    assert done.returncode == 0, done.stderr
    assert "RuntimeWarning" in done.stderr


def test_a_rival_of_unknown_distribution_is_found_by_its_files(tmp_path):
    done = run(install(tmp_path / "site", "trackers", "bicycle-tools"))
    assert done.returncode != 0
    assert "bicycle-tools" in done.stderr.strip().splitlines()[-1]


def test_a_stray_module_or_folder_in_front_is_found_out_too(tmp_path):
    """A user's own trackers.py beside the script, or a folder without __init__.py before ours."""
    (tmp_path / "trackers.py").write_text("x = 1\n")
    done = run(tmp_path)
    assert done.returncode != 0
    message = done.stderr.strip().splitlines()[-1]
    assert message.startswith("ImportError: ")
    assert "'trackers'" in message
    assert str(tmp_path / "trackers.py") in message


def test_a_rival_that_is_compiled_or_not_utf8_is_found_out_too(tmp_path):
    site = install(tmp_path / "site", "trackers", "trackers")
    (site / "trackers" / "__init__.py").write_bytes(b"# -*- coding: latin-1 -*-\n# \xe9\xff\xfe\n")
    done = run(site)
    assert done.returncode != 0
    assert done.stderr.strip().splitlines()[-1].startswith("ImportError: ")


@pytest.mark.parametrize("package", ["trackers", "agents"])
def test_our_packages_carry_the_distributions_name(package):
    source = (ROOT / package / "__init__.py").read_text(encoding="utf-8")
    assert 'DISTRIBUTION = "passive-env"' in source


def test_every_package_of_the_source_tree_is_installed():
    installed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    found = [file.parent.relative_to(ROOT) for top in TOP_LEVEL for file in (ROOT / top).rglob("__init__.py")]
    assert {".".join(folder.parts) for folder in found} <= set(installed)
    assert {name.split(".")[0] for name in installed} == set(TOP_LEVEL)


FORBIDDEN = {
    "trackers": ("gymnasium", "torch", "stable_baselines3", "matplotlib", "passive_env", "agents"),
    "passive_env": ("torch", "stable_baselines3", "agents", "matplotlib"),
}


@pytest.mark.parametrize("package", FORBIDDEN)
def test_floors_import_downwards_only(package):
    """design.md: agents → passive_env → trackers; only `agents` knows torch."""
    code = f"import {package}; print([m for m in {FORBIDDEN[package]!r} if m in sys.modules])"
    done = run(code=code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("package", FORBIDDEN)
def test_no_file_imports_from_a_floor_above(package):
    import ast

    upper = {"trackers": {"passive_env", "agents"}, "passive_env": {"agents"}}[package]
    for file in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in names} & upper, file

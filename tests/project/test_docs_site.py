"""The documents: links lead somewhere, names exist in the code, every page is in the site, and the site builds."""

import ast
import importlib
import importlib.util
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from skyless.cli.main import program

pytestmark = pytest.mark.site

ROOT = Path(__file__).parents[2]
PAGES = [
    *sorted(ROOT.glob("docs/**/*.md")),
    *(
        ROOT / name
        for name in (
            "README.md",
            "CHANGELOG.md",
            "CONTRIBUTING.md",
            "SECURITY.md",
            "examples/README.md",
            "firmware/README.md",
        )
    ),
]
CURRENT = [page for page in PAGES if page.name != "CHANGELOG.md"]
"""Those that describe the code as it is."""
SOURCES = ("tools", "src", "ros2", "tests", "benchmarks", "scripts", "firmware", "docs", "examples", "packaging")
OTHER_PROGRAMS = {
    "--dry-run",
    "--experimental-websocket",
    "--nthreads",
    "--nworkers",
    "--chiperase",
    "--no-dev",
    "--no-editable",
    "--compile-bytecode",
    "--help",
    "--home-dir",
    "--user",
    "--ros-args",
    "--spin-time",
    "--recover",
}
GENERATOR = ("sphinx", "myst_parser", "furo", "latex2mathml")

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
current_pages = pytest.mark.parametrize("page", CURRENT, ids=lambda page: str(page.relative_to(ROOT)))


def prose(page):
    """A page without its blocks of code."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"^(?: {4}(?! *[-*\d|]).*\n)+", "", text, flags=re.MULTILINE)


def code_spans(page):
    return re.findall(r"`([^`\n]+)`", prose(page))


@cache
def anchors(page):
    """The fragments that GitHub gives to a page's headings."""
    found = set()
    for title in re.findall(r"^#+ +(.*)$", prose(page), re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", title).replace("`", "")
        slug = re.sub(r"[^\w\- ]", "", plain.strip().lower()).replace(" ", "-")
        number = 0
        while (name := f"{slug}-{number}" if number else slug) in found:
            number += 1
        found.add(name)
    return frozenset(found)


WRITTEN = {".py", ".js", ".html", ".toml", ".service", ".env"}


@cache
def files():
    """All files of the repository's own folders, and their folders, as paths with a slash in front."""
    found = {f"/{folder}/" for folder in SOURCES}
    for folder in SOURCES:
        for path in (ROOT / folder).rglob("*"):
            if "__pycache__" not in path.parts:
                found.add("/" + path.relative_to(ROOT).as_posix() + ("/" if path.is_dir() else ""))
    return frozenset(found)


@cache
def words():
    """Every word that stands in the code."""
    found = set()
    for name in files():
        path = ROOT / name[1:]
        if path.suffix in {".py", ".js", ".html", ".toml", ".service", ".env"} or (
            "/scripts/" in name and path.is_file()
        ):
            found.update(re.findall(r"\w+", path.read_text(encoding="utf-8")))
    found.update(re.findall(r"\w+", (ROOT / "compose.yaml").read_text(encoding="utf-8")))
    return frozenset(found)


@cache
def our_options():
    """The options of all commands of ``skyless``."""

    def of(app):
        if app.default_command is not None:
            yield from (argument.name for argument in app.assemble_argument_collection(parse_docstring=True))
        for name in app:
            if not name.startswith("-"):
                yield from of(app[name])

    return frozenset(of(program()))


def navigation():
    for node in ast.parse((ROOT / "docs" / "conf.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and node.targets[0].id == "NAVIGATION":
            return ast.literal_eval(node.value)
    raise LookupError("docs/conf.py has no NAVIGATION")


@pages
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if target.startswith(("http://", "https://", "mailto:")):
            continue
        name, _, fragment = target.partition("#")
        other = (page.parent / name).resolve() if name else page
        assert other.exists(), f"{page.name}: {target}"
        if fragment:
            assert fragment in anchors(other), f"{page.name}: {target}"


@pages
def test_rows_of_a_table_have_as_many_cells_as_its_head(page):
    columns = None
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        if not line.startswith("|"):
            columns = None
            continue
        cells = len(re.findall(r"(?<!\\)\|", re.sub(r"`[^`]*`", "", line)))
        columns = columns or cells
        assert cells == columns, f"{page.name}:{number}"


@current_pages
def test_files_that_are_named_exist(page):
    names = [name for name in code_spans(page) if re.fullmatch(r"[\w./-]+\.(py|js)|[\w-]+(/[\w-]+)*/", name)]
    assert [name for name in names if not any(path.endswith(f"/{name}") for path in files())] == []


@current_pages
def test_names_of_the_code_exist(page):
    pattern = r"_?[A-Z][A-Z0-9_]{3,}|[a-z]+(_[a-z0-9]+)+|([A-Z][a-z0-9]+)+(\.\w+)*"
    names = [name for name in code_spans(page) if re.fullmatch(pattern, name)]
    assert [name for name in names if not words().issuperset(name.split("."))] == []


@current_pages
def test_examples_import_and_call_what_exists(page):
    for example in re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE):
        tree = ast.parse(example)
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(node.module)
                assert [name.name for name in node.names if not hasattr(module, name.name)] == []
            elif isinstance(node, ast.Attribute):
                assert node.attr in words(), node.attr


@current_pages
def test_options_that_are_named_exist(page):
    text = page.read_text(encoding="utf-8")
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+[a-z]", text)) - OTHER_PROGRAMS - our_options()
    assert sorted(option for option in named if option[2:].replace("-", "_") not in words()) == []


def test_every_page_is_in_the_navigation():
    listed = [entry for entries in navigation().values() for entry in entries]
    assert len(listed) == len(set(listed))
    assert {*listed, "README"} == {page.relative_to(ROOT).with_suffix("").as_posix() for page in PAGES}


def test_every_picture_is_shown():
    pattern = r"[(\"](?:docs/|\.\./)?pictures/(\w+\.(?:svg|webp))[)\"]"
    shown = {name for page in PAGES for name in re.findall(pattern, prose(page))}
    assert shown == {path.name for path in (ROOT / "docs" / "pictures").iterdir() if path.suffix in {".svg", ".webp"}}


def test_pictures_show_what_the_documents_and_the_code_say():
    spec = importlib.util.spec_from_file_location("make", ROOT / "docs" / "pictures" / "make.py")
    make = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make)
    for name, draw in make.PICTURES.items():
        drawn = (make.FOLDER / f"{name}.svg").read_text(encoding="utf-8")
        assert f">{make.content_of(draw())}<" in drawn, f"run docs/pictures/make.py {name}"


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in GENERATOR), reason="the dependency group docs is missing"
)
@pytest.mark.statistical
def test_the_site_builds_without_a_warning_and_needs_no_network(tmp_path):
    site = tmp_path / "site"
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "-c", ROOT / "docs",
         "-d", tmp_path / "doctrees", ROOT, site],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    for page in PAGES:
        html = (site / page.relative_to(ROOT)).with_suffix(".html").read_text(encoding="utf-8")
        assert not re.search(r"<(script|link|img)[^>]*(src|href)=\"https?://", html), page.name
    assert "README.html" in (site / "index.html").read_text(encoding="utf-8")
    assert "<math" in (site / "docs" / "maths.html").read_text(encoding="utf-8")
    start = (site / "README.html").read_text(encoding="utf-8")
    assert re.search(r"class=\"[^\"]*only-dark[^\"]*\"[^>]*src=\"_images/page_dark.webp\"", start)
    assert "skyless-site-check" in (site / "docs" / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "skyless.Receiver" in (site / "docs" / "reference" / "python.html").read_text(encoding="utf-8")

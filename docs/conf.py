"""The documentation's site: the Markdown files of the repository as pages, made by Sphinx (``scripts/docs``).

The source folder is the repository's root, so that links between README, docs and other files are what they are on
GitHub. Formulas become MathML when the site is made: no script and no network is needed to read it.
"""

import re
import sys
from collections.abc import Sequence
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

sys.path.insert(0, str(Path(__file__).parent))

import reference

from skyless.core import integrity
from skyless.sim import impairments
from skyless.sim.evaluation import request

# autodoc evaluates annotations; the module imports these names for type checkers only.
vars(request).update({name: value for module in (impairments, integrity) for name, value in vars(module).items()
                      if isinstance(value, type) and name not in vars(request)})  # fmt: skip

NAVIGATION = {
    "Tutorials": [
        "docs/start_here",
        "docs/tutorials/first_site",
        "docs/tutorials/first_replay",
        "docs/tutorials/everyday",
        "docs/tutorials/own_radio",
        "examples/README",
    ],
    "How to": [
        "docs/faq",
        "docs/howto/run_a_site",
        "docs/howto/watch_and_doctor",
        "docs/howto/alarms",
        "docs/howto/secure_a_site",
        "docs/howto/secure_the_air",
        "docs/howto/assets",
        "docs/setup",
        "docs/howto/simulate",
        "docs/howto/plan",
        "docs/howto/replay",
        "docs/howto/compare",
        "docs/howto/survey_and_calibrate",
        "docs/howto/study",
        "docs/howto/reproduce_the_paper",
        "docs/howto/raspberry_pi",
        "docs/howto/board_tag",
        "docs/howto/container",
        "docs/board",
        "docs/first_day",
        "docs/hardware",
        "firmware/README",
        "docs/extend",
        "CONTRIBUTING",
        "SECURITY",
    ],
    "In other tools": [
        "docs/tools/index",
        "docs/tools/ros2",
        "docs/tools/gpsd",
        "docs/tools/foxglove",
        "docs/tools/home_assistant",
        "docs/tools/prometheus",
        "docs/tools/geojson",
        "docs/tools/json_lines",
        "docs/tools/omlox",
        "docs/tools/ardupilot",
        "docs/tools/px4",
        "docs/tools/fira",
        "docs/tools/phones",
    ],
    "Reference": [
        "docs/reference/commands",
        "docs/reference/python",
        "docs/sites",
        "docs/page",
        "docs/live_site",
        "docs/mqtt",
        "docs/batches",
        "docs/hub",
        "docs/hub_operation",
        "docs/limits",
        "docs/reported",
        "docs/http",
        "docs/history",
        "docs/phases",
        "docs/protocol",
        "docs/protocol2",
        "docs/authentication",
        "docs/serial",
        "docs/glossary",
        "CHANGELOG",
    ],
    "Explanation": [
        "docs/architecture",
        "docs/comparison",
        "docs/maths",
        "docs/estimator_table",
        "docs/studies",
        "docs/recordings",
        "docs/planning",
        "docs/survey",
        "docs/calibration",
        "docs/watch",
        "docs/speed",
        "docs/paper",
        "docs/errata",
        "docs/radio",
        "docs/dw1000",
        "docs/dependencies",
    ],
}
"""Pages by the captions of the side bar; the start page is the README."""

project = "Skyless"
author = "the Skyless contributors"
html_title = "Skyless"
root_doc = "README"
include_patterns = ["README.md", *(f"{page}.md" for pages in NAVIGATION.values() for page in pages)]
exclude_patterns = [".*", "build", "dist", "out", "src", "tests", "benchmarks", "scripts"]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
myst_enable_extensions = ["attrs_inline", "dollarmath"]
myst_heading_anchors = 4
html_theme = "furo"
html_show_copyright = False
html_show_sourcelink = False
html_copy_source = False
html_math_renderer = "mathml"


def _add_navigation(_app: Sphinx, page: str, source: list[str]) -> None:
    """Put the side bar's table of contents on the start page; on GitHub the README has its own list of links."""
    if page == root_doc:
        for caption, pages in NAVIGATION.items():
            entries = "\n".join(f"/{entry}" for entry in pages)
            source[0] += f"\n\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{entries}\n```\n"


def _use_the_theme_of_the_site(_app: Sphinx, _page: str, source: list[str]) -> None:
    """Two pictures of which GitHub shows the one for its own theme become two of which the site's theme shows one."""
    source[0] = re.sub(
        r"<picture>\s*<source [^>]*srcset=\"([^\"]+)\">\s*<img src=\"([^\"]+)\" alt=\"([^\"]+)\"[^>]*>\s*</picture>",
        r"![\3](\2){.only-light}\n![\3](\1){.only-dark}",
        source[0],
    )


def _generate(_app: Sphinx, page: str, source: list[str]) -> None:
    """Pages of the reference: what stands in the repository is their beginning, the rest is made from the code."""
    if page in reference.PAGES:
        source[0] += reference.PAGES[page]()


def _generated_pages(*_: object) -> Sequence[str]:
    """Pages that are made again by every build, as the code may have changed."""
    return list(reference.PAGES)


def _inline_formula(translator: HTML5Translator, node: nodes.math) -> None:
    translator.body.append(_mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def _formula(translator: HTML5Translator, node: nodes.math_block) -> None:
    translator.body.append(f'<div class="math">{_mathml(node.astext(), "block")}</div>\n')
    raise nodes.SkipNode


def _mathml(tex: str, display: str) -> str:
    """A formula as MathML; a command that the converter does not know ends the build."""
    mathml = convert(tex, display=display)
    unknown = re.findall(r"\\\w+", mathml)
    if unknown:
        raise ValueError(f"latex2mathml does not know {', '.join(unknown)} in {tex}")
    return mathml


def _write_index(app: Sphinx, error: Exception | None) -> None:
    """The start page under the name that web servers look for."""
    if error is None and app.builder.format == "html":
        page = f'<!doctype html><meta http-equiv="refresh" content="0; url={root_doc}.html"><title>Skyless</title>\n'
        (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.add_lexer("hex", TextLexer)  # the bytes of protocol.md
    app.add_html_math_renderer("mathml", (_inline_formula, None), (_formula, None))
    app.connect("source-read", _add_navigation)
    app.connect("source-read", _use_the_theme_of_the_site)
    app.connect("source-read", _generate)
    app.connect("env-get-outdated", _generated_pages)
    app.connect("build-finished", _write_index)

"""Sphinx builds the pages of this folder: `uv run --group docs sphinx-build -nW docs docs/_build/html`."""

import os
from importlib.metadata import version as installed
from pathlib import Path

import click
from sphinx.application import Sphinx

import ftdrive

project = "ftdrive"
copyright = "the ftdrive authors"
version = release = installed("ftdrive")

extensions = [
    "myst_nb",  # Markdown, of which notebooks are a part
    "sphinx.ext.autodoc",
    "sphinx.ext.doctest",
    "sphinx.ext.intersphinx",
    "numpydoc",
    "sphinx_click",
    "sphinx_copybutton",
]
exclude_patterns = ["_build"]
default_role = "code"  # `name` in docstrings and in help texts, as in Markdown
smartquotes = False  # they turn --option into –option

nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 120  # the live one calibrates an emulated cell first

myst_heading_anchors = 3  # links to headings, as repositories make them

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings name units and shapes; NDArray[float64] fills a line and says neither
doctest_test_doctest_blocks = ""  # pytest runs the examples of docstrings, in a folder with their files
numpydoc_show_class_members = False  # the members follow anyway
nitpick_ignore_regex = [(r"py:.*", r"(?!ft(calib|drive|drivers)\b).*")]  # only our own names are checked

# References to other projects need the network, so only CI resolves them.
if os.environ.get("FTDRIVE_INTERSPHINX"):
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3", None),
        "numpy": ("https://numpy.org/doc/stable", None),
        "scipy": ("https://docs.scipy.org/doc/scipy", None),
    }

html_theme = "furo"
html_title = f"ftdrive {release}"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_search_scorer = str(Path(__file__).with_name("search.js"))  # headings that share most of the words typed
copybutton_exclude = ".linenos, .gp, .go"  # prompts and output are not copied


def _options(_: Sphinx, context: click.Context, lines: list[str]) -> None:
    """Write options as `--help` does; sphinx-click has its own words for defaults, choices and paths."""
    records = [parameter.get_help_record(context) for parameter in context.command.params]
    lines[:] = [line for found in records if found for line in (f".. option:: {found[0]}", "", f"   {found[1]}", "")]


def _arguments(_: Sphinx, __: click.Context, lines: list[str]) -> None:
    """Write nothing: the usage names the arguments, and the text of the command explains them."""
    lines.clear()


def _elsewhere(app: Sphinx, what: str, name: str, value: object, *_: object) -> bool | None:
    """Skip a name that another page of the API describes: that of ftdrivers for drivers, else that of ftdrive."""
    page = app.env.docname.rpartition("/")[2]
    if str(getattr(value, "__module__", "")).startswith("ftdrivers."):
        home = "ftdrivers"
    else:
        home = "ftdrive" if name in getattr(ftdrive, "__all__", ()) else page
    return True if what == "module" and page != home else None


def _module_text(_: Sphinx, what: str, __: str, ___: object, ____: object, lines: list[str]) -> None:
    """Leave out the text of a module: it is written for readers of the code, and the page has its own."""
    if what == "module":
        lines.clear()


def setup(app: Sphinx) -> None:
    """Connect them."""
    app.connect("autodoc-skip-member", _elsewhere)
    app.connect("autodoc-process-docstring", _module_text, priority=1000)  # after numpydoc
    app.connect("sphinx-click-process-options", _options)
    app.connect("sphinx-click-process-arguments", _arguments)

"""A report as one HTML page without a link to anything outside it."""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ftdrive import __version__
from ftdrive.errors import ConfigError
from ftdrive.report.document import Section
from ftdrive.report.figures import draw
from ftdrive.report.words import capital

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


def page(facts: Mapping[str, Any], sections: Sequence[Section]) -> str:
    """Write the page. Raises `ConfigError` without the extra `report`."""
    environment = templates("ftdrive.report", "a report in HTML", "pip install 'ftdrive[report]', or --format md")
    from markupsafe import Markup

    environment.filters["sentence"] = lambda text: with_code(capital(text))
    drawn = {one.name: Markup(draw(one.name, facts)) for section in sections for one in section.figures}
    template = environment.get_template("report.html.j2")
    return template.render(facts=facts, sections=sections, drawn=drawn, version=__version__)


def templates(package: str, what: str, fix: str) -> "Environment":
    """Return the templates of a package, which escape every value.

    Raises
    ------
    ConfigError
        jinja2 is not installed: `what` needs it, and `fix` says what to do.
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError:
        raise ConfigError(f"{what} needs jinja2: {fix}") from None
    return Environment(
        loader=PackageLoader(package),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def with_code(text: str) -> "Markup":
    """Escape a text, and set what stands between backticks as code."""
    from markupsafe import Markup, escape

    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text))))

"""A report as one HTML page without a link to anything outside it."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from ftdrive import __version__
from ftdrive.errors import ConfigError
from ftdrive.report.document import Section
from ftdrive.report.figures import draw


def page(facts: Mapping[str, Any], sections: Sequence[Section]) -> str:
    """Write the page. Raises `ConfigError` without the extra `report`."""
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
        from markupsafe import Markup, escape
    except ImportError:
        raise ConfigError("a report in HTML needs jinja2: pip install 'ftdrive[report]', or --format md") from None

    def sentence(text: str) -> Markup:
        """Escape a sentence, start it with a capital, and set what stands between backticks as code."""
        return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text[:1].upper() + text[1:]))))

    environment = Environment(
        loader=PackageLoader("ftdrive.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["sentence"] = sentence
    drawn = {one.name: Markup(draw(one.name, facts)) for section in sections for one in section.figures}
    template = environment.get_template("report.html.j2")
    return template.render(facts=facts, sections=sections, drawn=drawn, version=__version__)

"""One report as a page, as Markdown or as JSON."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from ftdrive import __version__
from ftdrive.errors import ConfigError
from ftdrive.report.document import Section, Table, capital
from ftdrive.report.figures import draw
from ftdrive.report.sections import sections_of
from ftdrivers.installation import missing_extra

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


def _markdown(facts: Mapping[str, Any], sections: Sequence[Section]) -> str:
    """Write the report; what a file or a device named cannot become markup."""
    return "\n".join(_lines(facts, sections)) + "\n"


def _lines(facts: Mapping[str, Any], sections: Sequence[Section]) -> Iterator[str]:
    yield f"# Calibration {facts['id']}: {', '.join([facts['verdict'].upper(), *facts['marks']])}\n"
    if facts["about"]:
        yield f"{_escaped(facts['about'])}.\n"
    yield f"Compensation error {_escaped(facts['error']['words'])}.\n"
    if facts["trust"]:
        yield f"{_escaped(capital(facts['trust']['words']))}.\n"
    remarks = [*facts["marks"].values(), *(one["words"] for one in [*facts["findings"], *facts["hints"]])]
    yield from (f"* {_escaped(capital(one))}" for one in remarks)
    yield f"\n**Next:** {_escaped(facts['next_step'])}\n"
    for section in sections:
        yield f"## {section.title}\n"
        yield from (f"{_escaped(one)}\n" for one in section.text)
        for table in section.tables:
            yield from _table(table)


def _table(table: Table) -> Iterator[str]:
    if table.caption:
        yield f"{_escaped(table.caption)}:\n"
    yield _row(table.columns)
    numbers = "---:" if len(table.columns) > 2 else "---"
    yield _row(["---", *[numbers] * (len(table.columns) - 1)], escape=False)
    yield from map(_row, table.rows)
    yield ""


def _row(cells: Sequence[str], *, escape: bool = True) -> str:
    return f"| {' | '.join(map(_escaped, cells) if escape else cells)} |"


def _escaped(text: str) -> str:
    """Keep code between backticks; escape the rest, and let nothing start a new line."""
    parts = re.split(r"(`[^`<>|\n]*`)", " ".join(text.split()))
    return "".join(
        one if k % 2 else re.sub(r"([\\|*\[\]`#])", r"\\\1", one).replace("&", "&amp;").replace("<", "&lt;")
        for k, one in enumerate(parts)
    )


def page(facts: Mapping[str, Any], sections: Sequence[Section]) -> str:
    """Write the page. Raises `ConfigError` without the extra `report`."""
    environment = templates("ftdrive.report", "a report in HTML", "report", "--format md")
    from markupsafe import Markup

    environment.filters["sentence"] = lambda text: with_code(capital(text))
    drawn = {one.name: Markup(draw(one.name, facts)) for section in sections for one in section.figures}
    template = environment.get_template("report.html.j2")
    return template.render(facts=facts, sections=sections, drawn=drawn, version=__version__)


def templates(package: str, what: str, extra: str, instead: str) -> "Environment":
    """Return the templates of a package, which escape every value.

    Raises
    ------
    ConfigError
        jinja2 is not installed: `what` needs it, `extra` has it, and the option `instead` does without it.
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError:
        raise ConfigError(f"{missing_extra(what, 'jinja2', extra)}, or give {instead}") from None
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


Format = Literal["html", "md", "json"]


def report(facts: Mapping[str, Any], form: Format = "html") -> str:
    """Write the report of these facts.

    Parameters
    ----------
    facts : mapping
        From `ftdrive.report.facts.facts_of`.
    form : {"html", "md", "json"}

    Returns
    -------
    str
        A self-contained page, Markdown, or the facts as one JSON object.

    Raises
    ------
    ConfigError
        A page is asked for without the extra `report`.
    """
    if form == "json":
        return json.dumps(facts, allow_nan=False) + "\n"
    sections = sections_of(facts)
    return _markdown(facts, sections) if form == "md" else page(facts, sections)

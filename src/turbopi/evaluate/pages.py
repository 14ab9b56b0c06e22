"""HTML pages from the templates in templates/. Every value in them is text: Jinja2 escapes it.

Results name what a policy server, a checkpoint or a simulator told, and may come from another machine. So no value is
ever marked as safe, and attributes in templates are quoted.
"""

from functools import lru_cache
from pathlib import Path

import jinja2

TEMPLATES = Path(__file__).parent / "templates"


def render(template: str, **values: object) -> str:
    """The page of a template. A value that the template needs and isn't given is an error."""
    return _environment().get_template(template).render(**values) + "\n"


@lru_cache
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )

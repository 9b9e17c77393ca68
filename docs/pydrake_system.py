"""Sphinx directive for the port diagrams in docstrings of Drake systems."""

import yaml
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class PydrakeSystem(SphinxDirective):
    """Shows the ports of a system as a table: inputs, the name of the system, outputs."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Returns the table."""
        system = yaml.safe_load("\n".join(self.content))
        inputs, outputs = (
            nodes.entry("", *(nodes.paragraph("", "", nodes.literal(text=str(port))) for port in system.get(key, [])))
            for key in ("input_ports", "output_ports")
        )
        name = nodes.entry("", nodes.paragraph("", "", nodes.strong(text=system["name"])))
        head = (nodes.entry("", nodes.paragraph(text=text)) for text in ("input ports", "system", "output ports"))
        group = nodes.tgroup("", *(nodes.colspec(colwidth=width) for width in (40, 30, 40)), cols=3)
        group += [nodes.thead("", nodes.row("", *head)), nodes.tbody("", nodes.row("", inputs, name, outputs))]
        return [nodes.table("", group, classes=["ports"])]


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the directive."""
    app.add_directive("pydrake_system", PydrakeSystem)
    return {"parallel_read_safe": True}

"""A Markdown extension that turns the formulas that ``pymdownx.arithmatex`` finds into MathML, which browsers draw.

Neither a script nor a font is needed in the page.
"""

from xml.etree.ElementTree import Element, fromstring

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.treeprocessors import Treeprocessor


class MathMlProcessor(Treeprocessor):
    """Replaces the TeX source in every element of the class ``arithmatex`` by MathML."""

    def run(self, root: Element) -> None:
        """Replace the formulas below an element."""
        for element in root.iter():
            if element.get("class") == "arithmatex" and element.text:
                opening, tex = element.text[:2], element.text[2:-2].strip()
                formula = fromstring(convert(tex, display="block" if opening == r"\[" else "inline"))
                for part in formula.iter():
                    part.tag = part.tag.rpartition("}")[2]  # MathML in HTML has no namespace
                element.text = None
                element.append(formula)


class MathMlExtension(Extension):
    """Adds the processor after the inline patterns, which find the formulas."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Register the processor."""
        md.treeprocessors.register(MathMlProcessor(md), "mathml", 15)  # inline patterns run at 20


def makeExtension(**options: object) -> MathMlExtension:
    """Return the extension, as Python-Markdown asks for it."""
    return MathMlExtension(**options)

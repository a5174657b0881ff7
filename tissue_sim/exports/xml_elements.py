"""Elements of an XML document with their lines; documents with a document type definition are refused."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from xml.parsers import expat

from tissue_sim.errors import InputError


@dataclass
class XmlElement:
    """Element of a document.

    Attributes:
        tag: name of the element.
        attributes: attributes by name.
        line: line of the start tag.
        text: text of the element without blanks at its ends.
        children: elements inside the element.
    """

    tag: str
    attributes: dict[str, str]
    line: int
    text: str = ""
    children: list[XmlElement] = field(default_factory=list)

    def find_child(self, tag: str) -> XmlElement | None:
        """Return the first child with a tag; None if there is none."""
        return next((child for child in self.children if child.tag == tag), None)

    def get_child(self, tag: str) -> XmlElement:
        """Return the first child with a tag.

        Raises:
            InputError: there is none.
        """
        child = self.find_child(tag)
        if child is None:
            raise InputError(f"<{self.tag}> must contain <{tag}>.", line=self.line)
        return child

    def read_number(self, tag: str, default: float) -> float:
        """Return the number in the child with a tag; `default` without the child.

        Raises:
            InputError: the text is no finite number, or the child has attributes, such as a map or a load curve.
        """
        child = self.find_child(tag)
        if child is None:
            return default
        child.require_attributes(())
        child.require_children(())
        return parse_number(child.text, child.line)

    def require_attributes(self, known: Collection[str]) -> None:
        """Raise an `InputError` if the element has another attribute."""
        for name in self.attributes:
            if name not in known:
                raise InputError(f"the attribute {name} of <{self.tag}> cannot be imported. Delete it if it does not "
                                 "change the response", line=self.line)

    def require_children(self, known: Collection[str], *, repeated: Collection[str] = ()) -> None:
        """Raise an `InputError` if a child has another tag, or occurs twice and is not in `repeated`."""
        seen = set()
        for child in self.children:
            if child.tag not in known:
                raise InputError(f"<{child.tag}> in <{self.tag}> cannot be imported. Delete it if it does not change "
                                 "the response", line=child.line)
            if child.tag in seen and child.tag not in repeated:
                raise InputError(f"<{child.tag}> occurs twice in <{self.tag}>. Delete one", line=child.line)
            seen.add(child.tag)


def parse_number(text: str, line: int) -> float:
    """Return the finite number of a text.

    Raises:
        InputError: the text is no finite number.
    """
    try:
        number = float(text) if "_" not in text else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"must be a finite number; got {text!r}.", line=line)
    return number


def parse_xml(text: str, expected: str) -> XmlElement:
    """Return the root element of a document.

    Args:
        text: text of the document.
        expected: description of the expected file for messages.

    Raises:
        InputError: invalid XML, or a document type definition, whose entities could refer to files or grow without
            limit.
    """
    parser = expat.ParserCreate()
    parser.buffer_text = True
    root = XmlElement("", {}, 0)
    path = [root]

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = XmlElement(tag, attributes, parser.CurrentLineNumber)
        path[-1].children.append(element)
        path.append(element)

    def end(tag: str) -> None:
        element = path.pop()
        element.text = element.text.strip()

    def add_text(data: str) -> None:
        path[-1].text += data

    def refuse_doctype(*_: object) -> None:
        raise InputError("a document type definition is not supported. Delete <!DOCTYPE>",
                         line=parser.CurrentLineNumber)

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = add_text, refuse_doctype
    try:
        parser.Parse(text, True)
    except (expat.ExpatError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"is not valid XML ({error}); expected {expected}",
                         line=parser.ErrorLineNumber or None) from None
    return root.children[0]

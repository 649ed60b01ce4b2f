"""XML of a map file, element by element, with the lines of the file.

Map files come from anywhere. A document type is refused, since entities can grow without limit or
name other files, and so is deep nesting. A document that ends early yields the elements before.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, NoReturn
from xml.parsers import expat

from ..errors import MapFileError

#: Bytes that are read at once.
CHUNK = 1 << 16
#: Deepest nesting; OpenDRIVE uses 9 levels.
MAX_DEPTH = 64


@dataclass(slots=True)
class Element:
    """An element of an XML document.

    Args:
        tag: name without its namespace.
        attributes: values as they are in the file.
        line: line of the file where it begins.
        children: elements in it.
        text: text in it.
    """

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)
    text: str = ""

    def get(self, name: str, default: str = "") -> str:
        """Return the value of an attribute."""
        return self.attributes.get(name, default)

    def all(self, tag: str) -> list[Element]:
        """Return the children with a tag."""
        return [child for child in self.children if child.tag == tag]

    def first(self, tag: str) -> Element | None:
        """Return the first child with a tag, or None."""
        return next((child for child in self.children if child.tag == tag), None)


class Document:
    """An XML document, read in one pass.

    ``error`` tells after the iteration why the rest of the document is not read, or is None.

    Args:
        stream: bytes of the document.
        name: of the file, for messages.

    Raises:
        MapFileError: the document has a document type, or is nested too deeply.
    """

    def __init__(self, stream: BinaryIO, name: str) -> None:
        self._stream, self._name = stream, name
        self._stack: list[Element] = []
        self._complete: list[Element] = []
        self._expat = expat.ParserCreate()
        self._expat.buffer_text = True
        self._expat.StartElementHandler = self._start
        self._expat.EndElementHandler = self._end
        self._expat.CharacterDataHandler = self._text
        self._expat.StartDoctypeDeclHandler = self._doctype
        self.root: Element | None = None
        self.error: str | None = None

    def elements(self) -> Iterator[Element]:
        """Yield the children of the root, each when it is complete."""
        try:
            while chunk := self._stream.read(CHUNK):
                self._expat.Parse(chunk)
                yield from self._take()
            self._expat.Parse(b"", True)  # noqa: FBT003 - takes no keyword
        except expat.ExpatError as error:
            self.error = f"line {error.lineno}: {expat.ErrorString(error.code)}"
        except (EOFError, OSError, zlib.error) as error:  # of a compressed file
            self.error = f"line {self._expat.CurrentLineNumber}: {error}"
        yield from self._take()

    def _take(self) -> list[Element]:
        complete, self._complete = self._complete, []
        return complete

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        line = self._expat.CurrentLineNumber
        element = Element(tag.rpartition(":")[2], attributes, line)
        if len(self._stack) >= MAX_DEPTH:
            self._refuse(f"elements are nested more than {MAX_DEPTH} deep")
        if not self._stack:
            self.root = element
        elif len(self._stack) > 1:  # the root holds no children: they are taken one by one
            self._stack[-1].children.append(element)
        self._stack.append(element)

    def _end(self, _tag: str) -> None:
        element = self._stack.pop()
        if len(self._stack) == 1:
            self._complete.append(element)

    def _text(self, text: str) -> None:
        if not text.isspace():
            self._stack[-1].text += text

    def _doctype(self, *_: object) -> NoReturn:
        self._refuse("a document type (<!DOCTYPE ...>) is not allowed in a map; remove it")

    def _refuse(self, why: str) -> NoReturn:
        raise MapFileError(f"{self._name}, line {self._expat.CurrentLineNumber}: {why}")

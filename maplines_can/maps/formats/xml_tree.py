"""XML of a map file, element by element, with the lines of the file.

Map files come from anywhere. A document type is refused, since entities can grow without limit or
name other files, and so is deep nesting. A document that ends early yields the elements before.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Container, Iterator
from sys import getsizeof
from typing import BinaryIO, NoReturn
from xml.parsers import expat

from ...values.errors import MapFileError
from ..lane import Skipped

#: Bytes that are read at once.
CHUNK = 1 << 16
#: Deepest nesting; OpenDRIVE uses 9 levels.
MAX_DEPTH = 64
#: Longest text of an element [characters].
MAX_TEXT = 1 << 16
#: Longest tag with its attributes [bytes].
MAX_TAG = 1 << 24
#: Memory of an element without its attributes [bytes].
ELEMENT = 200
#: Most memory of a child of the root with all that is in it, by ``memory_of`` [bytes].
MAX_CHILD = 1 << 27
#: Most elements of a document; 380 000 nodes of OSM with three tags each are 1.5 million.
MAX_ELEMENTS = 3_000_000


class Element:
    """An element of an XML document.

    Args:
        tag: name without its namespace.
        attributes: values as they are in the file.
        line: line of the file where it begins.

    Attributes:
        children: elements in it.
        text: text in it.
    """

    __slots__ = ("attributes", "children", "line", "tag", "text")

    def __init__(self, tag: str, attributes: dict[str, str], line: int) -> None:
        self.tag, self.attributes, self.line = tag, attributes, line
        self.children: list[Element] = []
        self.text = ""

    @property
    def place(self) -> str:
        """Where it is in its file, for messages."""
        named = f' id="{self.get("id")[:40]}"' if "id" in self.attributes else ""
        return f"line {self.line}, <{self.tag}{named}>"

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
        ignored: tags of elements that are left out.
        text_in: tags of elements whose text is kept; by default, of all.

    Raises:
        MapFileError: the document has a document type, an unknown encoding, too deep a nesting, too
            long a tag or text, too many elements, or too large a child of the root; during the
            iteration.
    """

    def __init__(
        self,
        stream: BinaryIO,
        name: str,
        ignored: Container[str] = (),
        text_in: Container[str] | None = None,
    ) -> None:
        self._stream, self._name = stream, name
        self._ignored, self._text_in = ignored, text_in
        self._stack: list[Element] = []
        self._complete: list[Element] = []
        self._ignored_depth = 0
        self._count = self._held = 0
        self._expat = expat.ParserCreate()
        self._expat.buffer_text = True
        self._expat.StartElementHandler = self._start
        self._expat.EndElementHandler = self._end
        self._expat.StartDoctypeDeclHandler = self._doctype
        if text_in is None:
            self._expat.CharacterDataHandler = self._text
        self.root: Element | None = None
        self.error: str | None = None

    def elements(self) -> Iterator[Element]:
        """Yield the children of the root, each when it is complete."""
        try:
            size = 0
            while chunk := self._stream.read(CHUNK):
                self._expat.Parse(chunk)
                size += len(chunk)
                if size - self._expat.CurrentByteIndex > MAX_TAG:
                    self._refuse(f"a tag has more than {MAX_TAG >> 20} MB")
                yield from self._take()
            self._expat.Parse(b"", True)
        except expat.ExpatError as error:
            self.error = f"line {error.lineno}: {expat.ErrorString(error.code)}"
        except MapFileError:
            raise
        except (LookupError, ValueError) as error:  # of the encoding that the document names
            raise MapFileError(f"{self._name}: {error}; save it as UTF-8") from None
        except (EOFError, OSError, zlib.error) as error:  # of a compressed file
            self.error = f"line {self._expat.CurrentLineNumber}: {error}"
        yield from self._take()

    def check_root(self, tag: str, format_name: str) -> list[Skipped]:
        """Return what is not used since the document ended early, after the iteration.

        Raises:
            MapFileError: the root has another tag, or there is none.
        """
        if self.root is None or self.root.tag != tag:
            why = self.error or f"the root element is <{self.root.tag if self.root else ''}>"
            raise MapFileError(f"{self._name} is not {format_name} file: {why}")
        if self.error is None:
            return []
        line, _, why = self.error.partition(": ")
        return [Skipped(line, f"{why}; the rest of the file is not used")]

    def _take(self) -> list[Element]:
        complete, self._complete = self._complete, []
        return complete

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        stack = self._stack
        if ":" in tag:
            tag = tag.rpartition(":")[2]
        if self._ignored_depth or tag in self._ignored:
            self._ignored_depth += 1
            return
        self._count += 1
        if self._count > MAX_ELEMENTS:
            self._refuse(f"more than {MAX_ELEMENTS} elements; divide the map into several")
        self._hold(memory_of(attributes), tag)
        element = Element(tag, attributes, self._expat.CurrentLineNumber)
        if len(stack) > 1:  # the root keeps no children: they are taken one by one
            stack[-1].children.append(element)
            if len(stack) >= MAX_DEPTH:
                self._refuse(f"elements are nested more than {MAX_DEPTH} deep")
        elif not stack:
            self.root = element
        stack.append(element)
        if self._text_in is not None and tag in self._text_in:
            self._expat.CharacterDataHandler = self._text

    def _end(self, _tag: str) -> None:
        if self._ignored_depth:
            self._ignored_depth -= 1
            return
        element = self._stack.pop()
        if len(self._stack) == 1:
            self._complete.append(element)
            self._held = 0
        if self._text_in is not None and element.tag in self._text_in:
            self._expat.CharacterDataHandler = None

    def _text(self, text: str) -> None:
        if self._stack and not self._ignored_depth:
            self._hold(getsizeof(text), self._stack[-1].tag)
            self._stack[-1].text += text
            if len(self._stack[-1].text) > MAX_TEXT:
                self._refuse(f"<{self._stack[-1].tag}> has more than {MAX_TEXT} characters of text")

    def _hold(self, size: int, tag: str) -> None:
        """Count the memory of the child of the root that is being read."""
        self._held += size
        if self._held > MAX_CHILD:
            top = self._stack[1].tag if len(self._stack) > 1 else tag
            self._refuse(
                f"<{top[:40]}> takes more than {MAX_CHILD >> 20} MB; divide it into several"
            )

    def _doctype(self, *_: object) -> NoReturn:
        self._refuse("a document type (<!DOCTYPE ...>) is not allowed in a map; remove it")

    def _refuse(self, why: str) -> NoReturn:
        raise MapFileError(f"{self._name}, line {self._expat.CurrentLineNumber}: {why}")


def memory_of(attributes: dict[str, str]) -> int:
    """Return about the memory of an element with these attributes [bytes]."""
    return ELEMENT + getsizeof(attributes) + sum(map(getsizeof, attributes.values()))


def number_in(text: str) -> float:
    """Return the number that a text is, or NaN.

    >>> number_in("1.5"), number_in("wide"), number_in("1_5")  # the last is one in Python only
    (1.5, nan, nan)
    """
    try:
        return float(text) if "_" not in text and text.isascii() else math.nan
    except ValueError:
        return math.nan

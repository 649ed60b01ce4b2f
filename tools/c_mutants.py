"""Mutants of a C source: each changes one operator, number, condition or statement."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

#: Texts that replace an operator.
OPERATORS: dict[str, tuple[str, ...]] = {
    "<": ("<=", ">="), "<=": ("<", ">"), ">": (">=", "<="), ">=": (">", "<"),
    "==": ("!=",), "!=": ("==",), "&&": ("||",), "||": ("&&",), "!": ("",),
    "+": ("-",), "-": ("+",), "*": ("/",), "/": ("*",), "%": ("*",), "~": ("",),
    "&": ("|",), "|": ("&",), "^": ("&",), "<<": (">>",), ">>": ("<<",),
    "+=": ("-=",), "-=": ("+=",), "*=": ("/=",), "/=": ("*=",), "|=": ("&=",), "&=": ("|=",),
    "^=": ("&=",), "<<=": (">>=",), ">>=": ("<<=",), "++": ("--",), "--": ("++",),
}  # fmt: skip
#: Operators that have another meaning where no value precedes them: an address, a sign.
UNARY = {"&": (), "*": (), "-": ("",), "+": ()}
TOKEN = re.compile(
    r"""(?P<space>\s+|//[^\n]*|/\*.*?\*/|\#(?:\\\n|[^\n])*)
    |(?P<text>"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*')
    |(?P<number>(?:0[xX][0-9a-fA-F.]+(?:[pP][+-]?\d+)?|\d[\d.]*(?:[eE][+-]?\d+)?|\.\d+)[uUlLfF]*)
    |(?P<name>[A-Za-z_]\w*)
    |(?P<operator><<=|>>=|\+\+|--|->|&&|\|\||[-+*/%&|^<>=!]=|<<|>>|.)""",
    re.VERBOSE | re.DOTALL,
)
#: Words that begin no statement that could be left out.
KEYWORDS = {
    "if", "else", "for", "while", "do", "switch", "case", "default", "return", "goto", "const",
    "static", "struct", "enum", "union", "sizeof",
}  # fmt: skip


class Mutant(NamedTuple):
    """One change of a source."""

    function: str  #: name of the function around it; "" outside of functions
    line: int
    original: str
    mutated: str
    start: int  #: places of the original in the source
    end: int

    def apply(self, source: str) -> str:
        """Return the source with the change."""
        return source[: self.start] + self.mutated + source[self.end :]


class _Token(NamedTuple):
    kind: str
    text: str
    start: int

    @property
    def end(self) -> int:
        return self.start + len(self.text)


def mutants(source: str) -> list[Mutant]:
    """Return all mutants of a source, in the order of their places.

    Comments, texts, preprocessor lines, assertions and declarations are not changed; the values
    that constants are given are. Some mutants do not compile.
    """
    tokens = [_Token(str(m.lastgroup), m[0], m.start()) for m in TOKEN.finditer(source)]
    tokens = [token for token in tokens if token.kind != "space"]
    found = []
    for function, first, last in _bodies(tokens):
        i, head = first, 0
        while i < last:
            if tokens[i].text in ("assert", "sizeof"):
                i = _closing(tokens, i + 1)
            if tokens[i].text == "for":
                head = _closing(tokens, i + 1)
            for start, end, text in _changes(tokens, i, is_head=i < head):
                line = source.count("\n", 0, start) + 1
                original = " ".join(source[start:end].split())
                found.append(Mutant(function, line, original, text, start, end))
            i += 1
    return sorted(found, key=lambda mutant: (mutant.start, mutant.end, mutant.mutated))


def _bodies(tokens: list[_Token]) -> Iterator[tuple[str, int, int]]:
    """Yield the name, first and last place of each function's body, and each constant's value."""
    i, name = 0, ""
    while i < len(tokens):
        text = tokens[i].text
        if text == "(" and tokens[i - 1].kind == "name":
            name = tokens[i - 1].text
            i = _closing(tokens, i)
        elif text == "{":
            last = _closing(tokens, i)
            if tokens[i - 1].text == ")":
                yield name, i + 1, last
            i = last
        elif text == "=":
            last = next(j for j in range(i, len(tokens)) if tokens[j].text == ";")
            yield "", i + 1, last
            i = last
        i += 1


def _closing(tokens: list[_Token], i: int) -> int:
    """Return the place of the bracket that closes the one at ``i``."""
    depth = 0
    for j in range(i, len(tokens)):
        depth += (tokens[j].text in "([{") - (tokens[j].text in ")]}")
        if depth == 0:
            return j
    return len(tokens) - 1


def _changes(tokens: list[_Token], i: int, *, is_head: bool) -> Iterator[tuple[int, int, str]]:
    """Yield the changes of the code that begins with a token: the place, and the new text.

    Args:
        tokens: of the source.
        i: number of the token.
        is_head: whether it is in the head of a loop, whose parts are not left out.
    """
    token, before = tokens[i], tokens[i - 1]
    if token.kind == "number":
        if before.text == "[" and _is_declared(tokens, i):
            return  # the size of an array
        for text in _other_numbers(token.text):
            yield token.start, token.end, text
    elif token.kind == "operator":
        is_binary = before.kind in ("name", "number") or before.text in (")", "]", "++", "--")
        is_binary = is_binary and before.text not in ("return", "case", "else")
        texts = OPERATORS.get(token.text, ())
        for text in texts if is_binary else UNARY.get(token.text, texts):
            yield token.start, token.end, text
    elif token.text in ("if", "while") and tokens[i + 1].text == "(":
        first, last = tokens[i + 1].end, tokens[_closing(tokens, i + 1)].start
        yield first, last, "0"
        if token.text == "if":  # a loop would not end
            yield first, last, "1"
    if not is_head and before.text in (";", "{", "}") and token.kind == "name":
        yield from _left_out(tokens, i)


def _is_declared(tokens: list[_Token], i: int) -> bool:
    """Return whether a token is in a declaration, before any value."""
    first = i
    while tokens[first - 1].text not in (";", "{", "}"):
        first -= 1
        if tokens[first].text == "=":
            return False
    kinds = tokens[first].kind, tokens[first + 1].kind
    is_type = kinds == ("name", "name") or tokens[first + 1].text == "*"
    return is_type and tokens[first].text not in ("return", "else", "case")


def _left_out(tokens: list[_Token], i: int) -> Iterator[tuple[int, int, str]]:
    """Yield the change that leaves out the statement at a token: an assignment, a call, a jump."""
    token, following = tokens[i], tokens[i + 1]
    if token.text != "return" and (
        token.text in KEYWORDS or following.kind == "name" or following.text == "*"
    ):
        return  # a declaration, too
    j = i
    while tokens[j].text not in (";", "{", "}", ")"):
        j = _closing(tokens, j) + 1 if tokens[j].text in ("(", "[") else j + 1
    if tokens[j].text == ";":
        yield token.start, tokens[j].start, ""


def _other_numbers(text: str) -> Iterator[str]:
    is_hex = text[:2].lower() == "0x"
    if re.search(r"[.pP]" if is_hex else r"[.eE]", text):
        value = float.fromhex(text) if is_hex else float(text.rstrip("fFlL"))
        yield from (f"({text} * 10.0)", f"({text} / 10.0)") if value else ("1.0",)
    else:
        digits = text.rstrip("uUlL")
        value = int(digits, 0) if is_hex else int(digits)
        for other in (value + 1, value - 1) if value else (1,):
            yield f"{other}{text[len(digits) :]}"

"""A codec in C and one of Python alone, in one process, and whether they answer alike."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any
from unittest.mock import patch

from both_senders import outcome

from maplines_can.wire import Codec, Decoder, Encoder
from maplines_can.wire.reception.native_decoder import NativeDecoder


@contextmanager
def python_alone() -> Iterator[None]:
    """Run Python alone, but for objects that were made with C before."""
    loaded = [one for name, one in sys.modules.items() if name.startswith("maplines_can.")]
    with ExitStack() as stack:
        for user in loaded:
            if vars(user).get("lib") is not None:
                stack.enter_context(patch.object(user, "lib", None))
        yield


def both(codec: Codec) -> tuple[Codec, Codec]:
    """Return a codec in C and one of Python alone, of the same DBC; they are checked to be that."""
    with python_alone():
        alone = Codec(codec.layout)
        alone.encoder()
    pair = codec, alone
    encoders, decoders = endpoints(pair)
    assert [one._c is not None for one in encoders] == [True, False]
    assert [isinstance(one, NativeDecoder) for one in decoders] == [True, False]
    kernels = [one._complete.format.kernel for one in pair if one._complete is not None]
    assert [one is not None for one in kernels] in ([], [True, False])
    return pair


def endpoints(pair: tuple[Codec, Codec]) -> tuple[list[Encoder], list[Decoder]]:
    """Return new encoders and decoders of both codecs."""
    return [one.encoder() for one in pair], [one.decoder() for one in pair]


def compare(ask: Callable[[Any], Any], pair: Sequence[Any], form: Callable[[Any], Any]) -> Any:
    """Check that both of a pair answer alike, in a form that can be compared; return the answer."""
    found = outcome(partial(ask, pair[0]))
    with python_alone():
        expected = outcome(partial(ask, pair[1]))
    assert form(found) == form(expected), (found, expected)
    return found

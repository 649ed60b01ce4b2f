"""CAN interfaces of the kernel, for the tests that run inside tools/vcan."""

import queue
import socket
import subprocess
from pathlib import Path
from typing import Any

from support.fake_bus import LONG


def has_vcan() -> Any:
    return any(name == "vcan0" for _, name in socket.if_nameindex())


def ip(arguments: Any) -> None:
    subprocess.run(["ip", *arguments.split()], check=True)


def set_up(name: Any, mtu: int = 72) -> None:
    if not Path("/sys/class/net", name).exists():
        ip(f"link add dev {name} type vcan")
    ip(f"link set {name} down")
    ip(f"link set {name} mtu {mtu} up")


class Events:
    """The ``on_event`` of a link, whose events a test waits for."""

    def __init__(self) -> None:
        self.events: Any = queue.SimpleQueue()

    def __call__(self, up: Any, text: Any) -> None:
        self.events.put((up, text))

    def expect(self, up: Any, words: Any) -> None:
        got, text = self.events.get(timeout=LONG)
        assert got is up
        assert words in text

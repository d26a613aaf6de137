"""Links between two network namespaces: as fast as this machine, or as slow as a mobile link.

Contract: each side runs its programs in a namespace of its own, so that all they say to each other crosses the link
and is counted there, in bytes of IP packets, TCP's own included. It needs root, as namespaces do.

`fast_link` is a veth pair. `slow_link` is a TUN device on each side, and between them a thread that holds each packet
as long as a line of so many bits a second and such a delay would: what netem does, which not every kernel has.
"""

import fcntl
import heapq
import json
import os
import select
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

CENTRAL_IP = "10.213.0.1"
STATION_IP = "10.213.0.2"
_MTU = 1500
_ETHERNET_BYTES = 14
_TUNSETIFF = 0x400454CA
_IFF_TUN_NO_PI = 0x1001


@dataclass(frozen=True, slots=True)
class Traffic:
    """Bytes of IP packets that crossed a link, both ways."""

    up: int
    """from the station to central"""
    down: int

    def since(self, before: "Traffic") -> "Traffic":
        """What crossed after that."""
        return Traffic(self.up - before.up, self.down - before.down)

    @property
    def both(self) -> int:
        """Up and down together."""
        return self.up + self.down


@dataclass(frozen=True, slots=True)
class Link:
    """Two namespaces that reach each other, and nothing else."""

    central: str
    station: str
    traffic: Callable[[], Traffic]
    """what has crossed so far"""


def inside(namespace: str, command: Sequence[str]) -> list[str]:
    """The command that runs a command in a namespace."""
    return ["ip", "netns", "exec", namespace, *command]


@contextmanager
def fast_link(*, whole_packets: bool = False) -> Iterator[Link]:
    """A link as fast as the machine.

    Args:
        whole_packets: Let the kernel hand over many packets as one, as it does on one machine: faster, but then the
            headers of most packets are not counted.
    """
    with _namespaces() as (central, station):
        _run("ip", "link", "add", "central", "netns", central, "type", "veth", "peer", "station", "netns", station)
        for namespace, device in ((central, "central"), (station, "station")):
            if not whole_packets:
                _run("ip", "-n", namespace, "link", "set", device, "gso_max_segs", "1")
            _up(namespace, device)

        def traffic() -> Traffic:
            said = json.loads(_run("ip", "-n", station, "-s", "-j", "link", "show", "station"))[0]["stats64"]
            sent, received = (said[way]["bytes"] - _ETHERNET_BYTES * said[way]["packets"] for way in ("tx", "rx"))
            return Traffic(sent, received)

        yield Link(central, station, traffic)


@contextmanager
def slow_link(bits_per_s: float, delay_s: float, queue_bytes: int = 1_500_000) -> Iterator[Link]:
    """A link of so many bits a second each way, on which each packet also takes a time of its own.

    Args:
        bits_per_s: Of IP packets, each way.
        delay_s: From one side to the other, beside what the bits take.
        queue_bytes: What may wait to be sent; more is lost. A thousand packets by default, as netem has it.
    """
    with _namespaces() as (central, station):
        devices = [_tun("vcentral", central), _tun("vstation", station)]
        up = _Line(devices[1], devices[0], bits_per_s, delay_s, queue_bytes)
        down = _Line(devices[0], devices[1], bits_per_s, delay_s, queue_bytes)
        stop, told = os.pipe()
        carrier = threading.Thread(target=_carry, args=((up, down), stop), daemon=True)
        carrier.start()
        try:
            yield Link(central, station, lambda: Traffic(up.carried, down.carried))
        finally:
            os.close(told)
            carrier.join()
            for descriptor in (stop, *devices):
                os.close(descriptor)


@dataclass(slots=True)
class _Line:
    """One way of a slow link: a queue before a line."""

    source: int
    target: int
    bits_per_s: float
    delay_s: float
    queue_bytes: int
    free_at: float = 0.0
    """when the last bit of what waits will have been sent"""
    underway: list[tuple[float, int, bytes]] = field(default_factory=list)
    """arrival, number, packet"""
    number: int = 0
    carried: int = 0

    def take(self, now: float) -> None:
        """Take packets over from the source, as many as there are; what finds the queue full is lost."""
        with suppress(BlockingIOError):
            while True:
                packet = os.read(self.source, _MTU)
                begins = max(now, self.free_at)
                if (begins - now) * self.bits_per_s / 8 > self.queue_bytes:
                    continue
                self.free_at = begins + len(packet) * 8 / self.bits_per_s
                self.number += 1
                heapq.heappush(self.underway, (self.free_at + self.delay_s, self.number, packet))

    def give(self, now: float) -> None:
        """Hand over what has arrived."""
        while self.underway and self.underway[0][0] <= now:
            packet = heapq.heappop(self.underway)[2]
            os.write(self.target, packet)
            self.carried += len(packet)

    def wait_s(self, now: float) -> float:
        """How long until the next packet arrives."""
        return max(0.0, self.underway[0][0] - now) if self.underway else 3600.0


def _carry(lines: Sequence[_Line], stop: int) -> None:
    while True:
        now = time.monotonic()
        ready, _, _ = select.select([*(line.source for line in lines), stop], [], [], min(x.wait_s(now) for x in lines))
        if stop in ready:
            return
        now = time.monotonic()
        for line in lines:
            if line.source in ready:
                line.take(now)
            line.give(now)


def _tun(device: str, namespace: str) -> int:
    """A TUN device in the namespace; the descriptor through which its packets come and go."""
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(descriptor, _TUNSETIFF, struct.pack("16sH", device.encode(), _IFF_TUN_NO_PI))
    _run("ip", "link", "set", device, "netns", namespace)
    _up(namespace, device)
    return descriptor


def _up(namespace: str, device: str) -> None:
    here, there = (CENTRAL_IP, STATION_IP) if "central" in device else (STATION_IP, CENTRAL_IP)
    _run("ip", "-n", namespace, "addr", "add", here, "peer", there, "dev", device)
    _run("ip", "-n", namespace, "link", "set", device, "mtu", str(_MTU), "up")


@contextmanager
def _namespaces() -> Iterator[tuple[str, str]]:
    """Two namespaces, each with nothing but its loopback."""
    names = f"vian-central-{os.getpid()}", f"vian-station-{os.getpid()}"
    made = []
    try:
        for name in names:
            _run("ip", "netns", "add", name)
            made.append(name)
            _run("ip", "-n", name, "link", "set", "lo", "up")
        yield names
    finally:
        for name in made:
            _run("ip", "netns", "del", name)


def _run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(
            f"{' '.join(command)}: {done.stderr.strip()}. Network namespaces need root and iproute2; "
            "Next: run this as root, or leave out the measurements over a link with --only"
        )
    return done.stdout

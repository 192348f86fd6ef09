"""Both links of one simulator at once, with several clients each: own numbers, rates and peers."""

from __future__ import annotations

import contextlib
import itertools
from collections import Counter

from sim_peer import Peer, simulator


def gaps(peer: Peer) -> int:
    """Messages that should have come between those that came."""
    numbers = [message.get_seq() for _, message in peer.received]
    return sum((b - a - 1) % 256 for a, b in itertools.pairwise(numbers))


def test_both_links_serve_several_clients_at_once() -> None:
    with contextlib.ExitStack() as stack:
        companion, station, late, other = (stack.enter_context(Peer()) for _ in range(4))
        stack.enter_context(
            simulator(
                *("--connect", f"udpout:127.0.0.1:{companion.port}"),
                *("--gcs", f"udpout:127.0.0.1:{station.port}"),
                *("--scenario", "calm"),
            )
        )
        companion.listen(lambda: companion.vehicle is not None)
        station.listen(lambda: station.vehicle is not None)
        assert companion.vehicle != station.vehicle
        for peer, link in ((late, station), (other, companion)):
            peer.vehicle = link.vehicle
            peer.heartbeat()
        peers = (companion, station, late, other)
        for peer in peers:
            peer.listen(lambda peer=peer: peer.time_s > 4.0)
        late.command(400, 1)  # a client that came later arms; every client of the link is told
        for peer in (late, station):
            peer.listen(lambda peer=peer: len(peer.of("COMMAND_ACK")) == 1)
        for peer in peers:
            peer.listen(lambda peer=peer: peer.time_s > 5.5)
            peer.listen(lambda peer=peer: peer.of("HEARTBEAT")[-1].base_mode & 128)
            assert gaps(peer) == 0
        assert not companion.of("COMMAND_ACK") + other.of("COMMAND_ACK")
    rates = [Counter(m.get_type() for _, m in peer.received) for peer in peers]
    assert rates[0]["ATTITUDE"] > 4 * rates[1]["ATTITUDE"]
    assert rates[2]["ATTITUDE"] > 30
    assert late.texts == ["Armed by external command"]

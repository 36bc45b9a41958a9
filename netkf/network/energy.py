"""What transmissions cost."""

from __future__ import annotations

from dataclasses import dataclass

from netkf.core.fields import Component, field, number


@dataclass(frozen=True, eq=False)
class Energy(Component):
    """What a node spends on sending; summaries then have ``joules``.

    joules_per_packet  of each transmission, or of each frame of a longer one, see network.radio; a
                       broadcast is one transmission
    joules_per_byte    of each byte of it, added to that
    """

    joules_per_packet: float = field(number(low=0.0), default=0.0)
    joules_per_byte: float = field(number(low=0.0), default=0.0)

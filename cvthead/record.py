"""What is known of a stored avatar without opening its file."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class AvatarRecord:
    """The record beside an avatar file.

    Attributes:
        id: random, unguessable, 32 hexadecimal digits.
        owner: who may use it; "" without owners.
        created, expires: seconds since the epoch; ``expires`` None keeps it for ever.
        bytes: size of the avatar file.
        preset, fingerprint: of the model that made it.
        box: left, top, right, bottom of the face in pixels of the portrait, if known.
    """

    id: str
    owner: str
    created: float
    expires: float | None
    bytes: int
    preset: str
    fingerprint: str
    box: Box | None = None

    @property
    def place(self) -> tuple[float, str]:
        """Sorts records by age."""
        return self.created, self.id


def write_record(record: AvatarRecord) -> bytes:
    """As JSON."""
    return json.dumps(asdict(record)).encode()


def read_record(data: bytes, key: str) -> AvatarRecord:
    """What :func:`write_record` wrote for the id ``key``, which no file can change.

    Raises:
        ValueError: something else.
    """
    try:
        fields = json.loads(data)
        box = fields["box"] and tuple(map(float, fields["box"]))
        return AvatarRecord(**fields | {"id": key, "box": box})
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"not a record: {error}") from error

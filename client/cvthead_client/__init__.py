"""Python client of the cvthead service: one photo of a person becomes a head that moves.

    from cvthead_client import Client, Controls

    with Client("http://127.0.0.1:8000") as client:
        avatar = client.create("portrait.jpg", consent=True)
        client.render(avatar.id, Controls(arkit={"jawOpen": 0.4})).save("frame.png")

``AsyncClient`` has the same methods as coroutines. Errors are in ``cvthead_client.errors``.
"""

from cvthead_client.aio import AsyncClient
from cvthead_client.client import Client
from cvthead_client.errors import CVTHeadClientError, ServiceError, TransportError
from cvthead_client.hello import Hello, StreamOutput
from cvthead_client.replies import Retry
from cvthead_client.session import Rendered, Report
from cvthead_client.stream import AsyncStream, Stream
from cvthead_client.types import (
    AvatarInfo,
    Camera,
    Controls,
    Output,
    Picture,
    Pose,
    Source,
    Tracked,
)
from cvthead_client.wire import CoefficientFrame, Stats

__version__ = "0.1.0"

__all__ = [
    "AsyncClient",
    "AsyncStream",
    "AvatarInfo",
    "CVTHeadClientError",
    "Camera",
    "Client",
    "CoefficientFrame",
    "Controls",
    "Hello",
    "Output",
    "Picture",
    "Pose",
    "Rendered",
    "Report",
    "Retry",
    "ServiceError",
    "Source",
    "Stats",
    "Stream",
    "StreamOutput",
    "Tracked",
    "TransportError",
]

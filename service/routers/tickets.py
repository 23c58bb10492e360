"""``POST /v1/tickets``: how a browser opens a stream when keys are set."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import BaseModel, Field

from service.keys import TenantDep
from service.problems import responses
from service.state import ServiceDep

router = APIRouter()


class Ticket(BaseModel):
    """Opens one stream as ``?ticket=``."""

    ticket: str = Field(description="Valid once.", examples=["q3Jm1s1u8mA..."])
    expires_in: float = Field(description="Seconds until it is worthless.", gt=0, examples=[30])


@router.post(
    "/v1/tickets",
    status_code=201,
    tags=["streams"],
    summary="A ticket for one WebSocket",
    responses=responses("unauthorized", "rate_limited", "overloaded", "draining"),
)
async def create(tenant: TenantDep, service: ServiceDep) -> Ticket:
    """Browsers cannot send a key with a WebSocket, and a key in a URL ends up in logs."""
    return Ticket(ticket=service.tickets.issue(tenant), expires_in=service.tickets.lifetime)

"""The routes of the gateway, one module for each part of the interface."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request
from pydantic import BaseModel, ConfigDict

from vggt_motion.gateway.results import Results
from vggt_motion.gateway.state import GatewayState


class NoQuery(BaseModel):
    """For routes without parameters: a mistyped one is an error and not silence."""

    model_config = ConfigDict(extra="forbid")


def _state(request: Request) -> GatewayState:
    state: GatewayState = request.app.state.gateway
    return state


def _results(request: Request) -> Results:
    results: Results = request.app.state.results
    return results


State = Annotated[GatewayState, Depends(_state)]
TheResults = Annotated[Results, Depends(_results)]

"""Figures for Prometheus."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST

from server.dependencies import NoQuery
from server.metrics import Metrics

router = APIRouter(tags=["operations"])


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
def metrics(request: Request, _: Annotated[NoQuery, Query()]) -> Response:
    """Ticks, streams, requests and caches, in Prometheus' text format. Starts no live world."""
    found = request.app.state.metrics
    assert isinstance(found, Metrics)
    return Response(found.text(), media_type=CONTENT_TYPE_LATEST)

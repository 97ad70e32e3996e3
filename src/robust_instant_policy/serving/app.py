"""The two protocols of the server: openpi's websocket at ``/``, HTTP with JSON at ``/plans``."""

import asyncio
import logging
import secrets
import traceback
from functools import partial
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Query, Request, Security, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, PlainTextResponse
from fastapi.security import APIKeyHeader
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException as AnyHTTPException  # also of unknown paths and methods
from starlette.websockets import WebSocketDisconnect

from robust_instant_policy import __version__
from robust_instant_policy.errors import RipError
from robust_instant_policy.files import excerpt
from robust_instant_policy.serving.guard import MAX_CONNECTIONS, MAX_MESSAGE_BYTES, Guard
from robust_instant_policy.serving.messages import (
    MAX_NAME,
    MessageError,
    as_json,
    describe,
    pack,
    read_image,
    read_observation,
    read_robot,
    reply,
    unpack,
)
from robust_instant_policy.serving.planner import CancelledPlanError, Job, Planner, QueueError

logger = logging.getLogger(__name__)
MAX_WAIT_S = 600.0  # for which one HTTP request may wait for its plan
INTERNAL_ERROR = 1011  # close code

Wait = Annotated[float, Query(ge=0, le=MAX_WAIT_S, description="seconds to wait for the end of the plan")]


class PlanRequest(BaseModel):
    """An RGB-D image with its calibrated camera."""

    rgb: str = Field(description="the image, PNG or JPEG in base64")
    depth: str = Field(description="the depth image of the same size, 16-bit PNG in base64; 0: no reading")
    depth_unit_m: float = Field(gt=0, description="metres per step of depth; 0.001: millimetres")
    intrinsics: list[list[float]] = Field(description="(3, 3) in pixels")
    camera_pose: list[list[float]] = Field(description="(4, 4), camera to world, OpenCV axes")
    robot: str = Field("robot", min_length=1, max_length=MAX_NAME, description="one plan at a time for each robot")

    def content(self) -> dict[str, Any]:
        """The same as a map with pixels. Raises `MessageError`."""
        return {**vars(self), "rgb": read_image("rgb", self.rgb), "depth": read_image("depth", self.depth)}


def make_app(planner: Planner, host: str, key: str | None, debug: bool = False) -> FastAPI:
    """The ASGI application; ``debug`` sends tracebacks to clients."""
    app = FastAPI(title="Robust Instant Policy", version=__version__, redoc_url=None)
    app.add_middleware(Guard, host=host, key=key)
    _add_errors(app, debug)
    _add_http(app, planner, debug)
    _add_websocket(app, planner, debug)
    return app


def _tell(error: BaseException, debug: bool) -> str:
    """The error as one line, or with ``debug`` its traceback."""
    if debug:
        return "".join(traceback.format_exception(error))
    return str(error) if isinstance(error, RipError) else f"unexpected {type(error).__name__} in the server"


def _add_errors(app: FastAPI, debug: bool) -> None:
    """Every error is an object with one line, ``error``."""

    @app.exception_handler(AnyHTTPException)
    async def refused(request: Request, error: AnyHTTPException) -> JSONResponse:
        return JSONResponse({"error": error.detail}, error.status_code, error.headers)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        problems = [
            f"the body is not JSON: {one['ctx']['error']}"
            if one["type"] == "json_invalid"
            else f"{'.'.join(map(str, one['loc'][1:])) or 'body'}: {one['msg']}"
            for one in error.errors()
        ]
        return JSONResponse({"error": excerpt("; ".join(problems))}, 422)

    async def failed(request: Request, error: Exception, status: int) -> JSONResponse:
        return JSONResponse({"error": _tell(error, debug)}, status)

    for kind, status in ((MessageError, 422), (QueueError, 429), (Exception, 500)):  # uvicorn logs the last
        app.add_exception_handler(kind, partial(failed, status=status))


def _add_http(app: FastAPI, planner: Planner, debug: bool) -> None:
    with_key = [Security(APIKeyHeader(name="Authorization", auto_error=False, description="Api-Key KEY"))]

    def state(job: Job) -> dict[str, Any]:
        told: dict[str, Any] = {"id": job.id, "robot": job.robot, "state": job.state}
        if told["state"] == "done":
            return told | as_json(reply(planner, job))
        if told["state"] in ("refused", "failed"):
            return told | {"error": _tell(job.future.exception(), debug)}  # type: ignore[arg-type]
        return told | {"stage": job.stage, "done": job.done, "total": job.total}

    def find(plan_id: str) -> Job:
        job = planner.find(plan_id)
        if job is None:
            raise HTTPException(404, "there is no such plan, or it ended long ago")
        return job

    async def wait_for(job: Job, seconds: float) -> dict[str, Any]:
        if seconds and not job.future.done():
            await asyncio.wait({asyncio.wrap_future(job.future)}, timeout=seconds)
        return state(job)

    @app.get("/healthz", response_class=PlainTextResponse)
    async def healthz() -> str:
        """Whether the server runs."""
        return "OK\n"

    @app.get("/metadata", dependencies=with_key)
    async def metadata() -> dict[str, Any]:
        """What the server plans, what it needs and what it answers; openpi's clients get the same on connecting."""
        return describe(planner)

    @app.post("/plans", status_code=201, dependencies=with_key)
    async def ask(request: PlanRequest, wait: Wait = 0.0) -> dict[str, Any]:
        """Queue a plan; with ``wait`` the answer holds its actions, or why it is refused."""
        observation = await asyncio.to_thread(lambda: read_observation(request.content()))
        return await wait_for(planner.submit(request.robot, observation), wait)

    @app.get("/plans", dependencies=with_key)
    async def queue() -> list[dict[str, Any]]:
        """The plan under way and those that wait, also of openpi's clients."""
        return [state(job) for job in planner.queue]

    @app.get("/plans/{plan_id}", dependencies=with_key)
    async def look(plan_id: str, wait: Wait = 0.0) -> dict[str, Any]:
        """Progress of a plan, or its actions, or why it is refused."""
        return await wait_for(find(plan_id), wait)

    @app.delete("/plans/{plan_id}", dependencies=with_key)
    async def cancel(plan_id: str) -> dict[str, Any]:
        """Cancel a plan; one under way stops at its next step."""
        job = find(plan_id)
        planner.cancel(job)
        return state(job)


def _add_websocket(app: FastAPI, planner: Planner, debug: bool) -> None:
    connections: set[WebSocket] = set()

    @app.websocket("/")
    async def openpi(socket: WebSocket) -> None:
        if len(connections) >= MAX_CONNECTIONS:
            full = JSONResponse({"error": f"the server has {MAX_CONNECTIONS} connections, try again later"}, 503)
            return await socket.send_denial_response(full)
        connections.add(socket)
        try:
            await socket.accept()
            await socket.send_bytes(pack(describe(planner)))
            await _converse(socket, planner, debug)
        except WebSocketDisconnect:
            return
        except Exception as error:
            if not isinstance(error, RipError):
                logger.exception("unexpected error in a websocket")
            await _end(socket, _tell(error, debug))
        finally:
            connections.discard(socket)


async def _converse(socket: WebSocket, planner: Planner, debug: bool) -> None:
    """Answer one observation after the other until the client hangs up; raises what is wrong."""
    name = f"connection {secrets.token_hex(4)}"
    incoming = asyncio.ensure_future(socket.receive())
    try:
        while (message := await incoming)["type"] != "websocket.disconnect":
            # Reading goes on during a plan: for keep-alive messages, and to notice that the client has hung up.
            incoming = asyncio.ensure_future(socket.receive())
            if message.get("bytes") is None:
                raise MessageError("an observation is a binary message, this is text")
            if len(message["bytes"]) > MAX_MESSAGE_BYTES:
                raise MessageError(f"the message is larger than {MAX_MESSAGE_BYTES >> 20} MiB")
            content = await asyncio.to_thread(unpack, message["bytes"])
            observation = await asyncio.to_thread(read_observation, content)
            job = planner.submit(read_robot(content, name), observation)
            try:
                planned = asyncio.wrap_future(job.future)
                await asyncio.wait({incoming, planned}, return_when=asyncio.FIRST_COMPLETED)
                if not planned.done():
                    if incoming.result()["type"] == "websocket.disconnect":
                        return
                    raise MessageError("a plan is under way; wait for its answer before the next observation")
            finally:
                planner.cancel(job)  # without effect on one that has ended
            if planned.cancelled():
                raise CancelledPlanError("the plan was cancelled")
            error = planned.exception()
            if error is not None:  # the planner has logged what is unexpected
                return await _end(socket, _tell(error, debug))
            await socket.send_bytes(pack(reply(planner, job)))
    finally:
        incoming.cancel()


async def _end(socket: WebSocket, text: str) -> None:
    """openpi's way to tell an error: a text message, then the close code. The client may have hung up."""
    try:
        await socket.send_text(text)
        await socket.close(INTERNAL_ERROR, "see the text message before")
    except (RuntimeError, OSError):
        return

"""The daemon's HTTP routes. A refusal is always JSON: {"problem": ..., "remedy": ...}."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path as FilePath
from typing import Annotated, Any, Final, Protocol

from fastapi import FastAPI, Path, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException

from controller.daemon.feed import EventFeed, plain
from controller.packml import Command, State
from controller.store import RecordNotFound, RecordRefused, Result, Run, Store
from estimation.errors import CellError, IllegalTransition, StoreError

log = logging.getLogger(__name__)

_LARGEST_ID: Final = 2**63 - 1  # of an SQLite row
_COMMANDS: Final = {command.value.lower(): command for command in Command}

Identifier = Annotated[int, Field(ge=1, le=_LARGEST_ID)]
Reporter = Callable[[int | None], Sequence[FilePath]]
"""Writes the report of a run (None: the newest) and says where."""


class Reply(Protocol):
    """An accepted command."""

    @property
    def command(self) -> Command:
        """The command."""

    @property
    def state(self) -> State:
        """The state right after it."""


class CellEngine(Protocol):
    """What the daemon asks of the engine; every method may be called from any thread."""

    def submit(self, command: Command, who: str, reason: str = "") -> Reply:
        """Obey or refuse at once; Stop and Abort stop the arm first. Raises IllegalTransition."""

    def status(self) -> dict[str, Any]:
        """A snapshot for people and scripts."""

    def subscribe(self, listener: Callable[[dict[str, Any]], None], /) -> Callable[[], None]:
        """Call `listener` with every event; returns how to unsubscribe."""

    def run_forever(self) -> None:
        """Act until `shutdown`; belongs to the engine's own thread."""

    def shutdown(self) -> None:
        """Stop the arm and end `run_forever`."""


class Who(BaseModel):
    """Who commands, and why; both go into the audit trail."""

    model_config = ConfigDict(extra="forbid", str_strip_whitespace=True)

    who: str = Field(default="operator", min_length=1, max_length=100)
    reason: str = Field(default="", max_length=500)


def create_app(engine: CellEngine, store: Store, feed: EventFeed, report: Reporter) -> FastAPI:
    """All routes over one engine and its store."""
    app = FastAPI(title="truecell", docs_url=None, redoc_url=None)

    @app.post("/command/{name}")
    def command(name: str, body: Who) -> dict[str, Any]:
        if (chosen := _COMMANDS.get(name.lower())) is None:
            raise RecordNotFound(f"No command {name!r}", f"Commands: {', '.join(_COMMANDS)}")
        reply = engine.submit(chosen, body.who, body.reason)
        return {"command": reply.command, "state": reply.state, "state_no": reply.state.number}

    @app.get("/status")
    def status() -> Any:
        return plain(engine.status())

    @app.get("/events")
    async def events() -> StreamingResponse:
        return StreamingResponse(feed.stream(engine.status), media_type="text/event-stream")

    @app.get("/results")
    def results(run: Identifier | None = None) -> dict[str, Any]:
        if run is None:
            found = store.latest_results()
        else:
            store.run(run)  # "no such run" is another answer than "no results yet"
            found = store.results(run)
        return {"results": [_shown_result(result) for result in found]}

    @app.get("/history")
    def history(limit: Annotated[int, Query(ge=1, le=1000)] = 20) -> dict[str, Any]:
        return {"runs": [_shown_run(run, store.results(run.id)) for run in store.runs(limit)]}

    @app.get("/audit")
    def audit(since: Annotated[int, Query(ge=0, le=_LARGEST_ID)] = 0) -> dict[str, Any]:
        return {"events": [asdict(event) for event in store.events(since)]}

    @app.get("/report")
    def write_report(run: Identifier | None = None) -> dict[str, Any]:
        if run is not None:
            store.run(run)
        return {"files": [str(path) for path in report(run)]}

    @app.get("/samples")
    def samples(run: Identifier | None = None, phase: str | None = None) -> dict[str, Any]:
        newest = store.runs(1)
        if run is None and not newest:
            return {"samples": []}
        chosen = newest[0].id if run is None else store.run(run).id
        return {"samples": [asdict(s) for s in store.samples(chosen, phase, include_excluded=True)]}

    @app.post("/samples/{sample}/exclude")
    def exclude(sample: Annotated[Identifier, Path()], body: Who) -> dict[str, Any]:
        store.exclude(sample, body.reason, body.who)
        return {"sample": sample, "mark": "excluded"}

    @app.post("/samples/{sample}/retake")
    def retake(sample: Annotated[Identifier, Path()], body: Who) -> dict[str, Any]:
        store.retake(sample, body.reason, body.who)
        return {"sample": sample, "mark": "retake"}

    _answer_errors(app)
    return app


def _shown_run(run: Run, results: Sequence[Result]) -> dict[str, Any]:
    shown = {key: value for key, value in asdict(run).items() if key != "cell_text"}
    return {**shown, "verdicts": {result.phase: result.verdict for result in results}}


def _shown_result(result: Result) -> dict[str, Any]:
    return {key: value for key, value in asdict(result).items() if key != "belief"}


def _answer_errors(app: FastAPI) -> None:
    """Every refusal in the same form, whoever refuses."""

    @app.exception_handler(CellError)
    def refused(_request: Request, error: CellError) -> JSONResponse:
        return _refusal(_status_of(error), error.problem, error.remedy)

    @app.exception_handler(RequestValidationError)
    def invalid(_request: Request, error: RequestValidationError) -> JSONResponse:
        problems = (f"{'.'.join(map(str, d['loc']))}: {d['msg']}" for d in error.errors())
        return _refusal(422, "; ".join(problems), "Correct the request")

    @app.exception_handler(HTTPException)
    def unknown(request: Request, error: HTTPException) -> JSONResponse:
        return _refusal(
            error.status_code, f"{error.detail}: {request.method} {request.url.path}", "See docs/console.md"
        )

    @app.exception_handler(Exception)
    def defect(_request: Request, error: Exception) -> JSONResponse:
        # The words of an unforeseen error may tell more than a client should know: they stay in the log.
        return _refusal(500, f"Internal error ({type(error).__name__})", "Report it with the daemon's log")


def _status_of(error: CellError) -> int:
    match error:
        case RecordNotFound():
            return 404
        case IllegalTransition() | RecordRefused():
            return 409
        case StoreError():
            return 503
        case _:
            return 409


def _refusal(status: int, problem: str, remedy: str) -> JSONResponse:
    return JSONResponse({"problem": problem, "remedy": remedy}, status_code=status)

"""Commands to the cell and questions about it: all go to the daemon."""

from collections.abc import Callable
from typing import Annotated, Any, Final

import typer

from controller.console import options
from controller.console.exit_codes import code_of_status, code_of_verdicts
from controller.console.options import JsonOption, RunOption, SocketOption, WhoOption

ReasonOption = Annotated[str, typer.Option("--reason", help="Why; goes into the audit trail.")]
WaitOption = Annotated[
    bool, typer.Option("--wait", help="Watch until the cell waits for somebody; the exit code says why.")
]
UntilOption = Annotated[
    bool,
    typer.Option("--until-waiting", help="End when the cell waits for somebody; the exit code says why."),
]

# name, what it does, example
_STATE_COMMANDS: Final = (
    ("hold", "Pause at the next measurement; the cause lies inside the cell.", "--reason 'clean the lens'"),
    ("suspend", "Pause at the next measurement; the cause lies outside the cell.", "--reason 'no part'"),
    ("stop", "Request a stop of the arm now. The run ends without a verdict.", ""),
    ("abort", "Request a stop of the arm now, and latch. Clear and Reset come before the next Start.", ""),
    ("complete", "End a held or suspended run now. A phase without result makes it Undefined.", ""),
)
# These take a second or two, and the next command is refused until they have ended.
_SETTLING_COMMANDS: Final = (
    ("clear", "Acknowledge what led to Aborted. Links are opened and identities read again.", ""),
    ("reset", "From Stopped or Completed to Idle, ready for Start.", ""),
)
_WAITING_COMMANDS: Final = (
    ("start", "Start the job, or go on with the run that a crash cut off.", "--wait"),
    ("unhold", "Go on after Held: a known point is measured again first.", "--wait"),
    ("unsuspend", "Go on after Suspended: a known point is measured again first.", "--wait"),
)


def _plain_command(name: str) -> Callable[..., None]:
    def give(
        reason: ReasonOption = "",
        who: WhoOption = None,
        socket: SocketOption = None,
        as_json: JsonOption = False,
    ) -> None:
        with options.daemon(socket) as client:
            reply = client.post(f"/command/{name}", options.person(who), reason)
        options.print_json(reply) if as_json else typer.echo(f"{reply['command']}: now {reply['state']}")

    return give


def _settling_command(name: str) -> Callable[..., None]:
    def give(
        reason: ReasonOption = "",
        who: WhoOption = None,
        socket: SocketOption = None,
        as_json: JsonOption = False,
    ) -> None:
        from controller.console.show import fault_text
        from controller.console.watch import NoView, follow

        reply: dict[str, Any] = {}
        with options.daemon(socket) as client:

            def command() -> None:
                reply.update(client.post(f"/command/{name}", options.person(who), reason))

            status = follow(client, NoView(), until_waiting=True, once_connected=command)
        if as_json:
            options.print_json({**reply, "state": status["state"], "state_no": status["state_no"]})
        else:
            typer.echo(f"{reply['command']}: now {status['state']}")
        if status.get("fault"):
            typer.echo(fault_text(status["fault"]), err=True)
            raise typer.Exit(code_of_status(status))

    return give


def _waiting_command(name: str) -> Callable[..., None]:
    give_at_once = _plain_command(name)

    def give(
        reason: ReasonOption = "",
        who: WhoOption = None,
        wait: WaitOption = False,
        socket: SocketOption = None,
        as_json: JsonOption = False,
    ) -> None:
        if not wait:
            give_at_once(reason, who, socket, as_json)
            return
        from controller.console.watch import choose_view, follow

        with options.daemon(socket) as client:

            def command() -> None:
                client.post(f"/command/{name}", options.person(who), reason)

            status = follow(client, choose_view(as_json), until_waiting=True, once_connected=command)
        raise typer.Exit(code_of_status(status))

    return give


def status(
    links: Annotated[
        bool, typer.Option("--links", help="Show instead how each link does: frames, faults, answer times.")
    ] = False,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show state, job, fault and links of the cell.

    Example: truecell status --links
    """
    from controller.console import show

    with options.daemon(socket) as client:
        answer = client.get("/status")
    if as_json:
        options.print_json(answer)
    else:
        show.console().print((show.links_table if links else show.status_table)(answer))


def watch(
    until_waiting: Annotated[
        bool,
        typer.Option("--until-waiting", help="End when the cell waits for somebody; the exit code says why."),
    ] = False,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show what happens as it happens. Live on a terminal, one line per event elsewhere.

    Example: truecell watch --until-waiting
    """
    from controller.console.watch import choose_view, follow

    with options.daemon(socket) as client:
        raise typer.Exit(code_of_status(follow(client, choose_view(as_json), until_waiting)))


def results(
    run: RunOption = None,
    exit_code: Annotated[
        bool, typer.Option("--exit-code", help="Return the worst verdict as exit code.")
    ] = False,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show verdicts with their numbers and limits. For one --run with every attempt.

    Example: truecell results --run 3
    """
    from controller.console import show

    with options.daemon(socket) as client:
        answer = client.get("/results", run=run)
    if as_json:
        options.print_json(answer)
    elif answer["results"]:
        show.console().print(show.results_table(answer["results"]))
    else:
        typer.echo("No results yet.")
    if exit_code:
        newest = {result["phase"]: result["verdict"] for result in answer["results"]}
        raise typer.Exit(code_of_verdicts(list(newest.values())))


def history(
    limit: Annotated[int, typer.Option("--limit", min=1, max=1000, help="At most so many runs.")] = 20,
    events: Annotated[bool, typer.Option("--events", help="The audit trail instead of the runs.")] = False,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show earlier runs, or with --events who did what when.

    Example: truecell history --limit 5
    """
    from controller.console import show

    with options.daemon(socket) as client:
        answer = client.get("/audit") if events else client.get("/history", limit=limit)
    if as_json:
        options.print_json(answer)
    elif events:
        for event in answer["events"]:
            time = show.local_time(event["utc_s"])
            typer.echo(f"{event['sequence']:6d}  {time}  {event['kind']}: {event['text']}")
    else:
        show.console().print(show.history_table(answer["runs"]))


def report(run: RunOption = None, socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Write the report of a run and say where it is.

    Example: truecell report --run 3
    """
    with options.daemon(socket) as client:
        answer = client.get("/report", run=run)
    options.print_json(answer) if as_json else typer.echo("\n".join(answer["files"]))


samples = typer.Typer(no_args_is_help=True, help="List measurements, and mark those that must not count.")


@samples.command("list")
def list_samples(
    run: RunOption = None,
    phase: Annotated[str | None, typer.Option("--phase", help="Of this phase only.")] = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the measurements of a run with their numbers.

    Example: truecell samples list --phase hand-eye
    """
    from controller.console import show

    with options.daemon(socket) as client:
        answer = client.get("/samples", run=run, phase=phase)
    options.print_json(answer) if as_json else show.console().print(show.samples_table(answer["samples"]))


SampleArgument = Annotated[
    int, typer.Argument(min=1, help="Number of the sample, from `truecell samples list`.")
]
NeededReason = Annotated[
    str, typer.Option("--reason", help="Why; goes into the audit trail.", show_default=False)
]


@samples.command()
def exclude(
    sample: SampleArgument,
    reason: NeededReason,
    who: WhoOption = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Keep a measurement out of every later estimate. It stays in the record; this is final.

    Example: truecell samples exclude 17 --reason 'chip on the face'
    """
    _mark(sample, "exclude", reason, who, socket, as_json)


@samples.command()
def retake(
    sample: SampleArgument,
    reason: NeededReason,
    who: WhoOption = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """As exclude, and measure at the same place again.

    Example: truecell samples retake 17 --reason 'somebody touched the part'
    """
    _mark(sample, "retake", reason, who, socket, as_json)


def _mark(
    sample: int, verb: str, reason: str, who: WhoOption, socket: SocketOption, as_json: JsonOption
) -> None:
    with options.daemon(socket) as client:
        answer = client.post(f"/samples/{sample}/{verb}", options.person(who), reason)
    options.print_json(answer) if as_json else typer.echo(f"Sample {sample}: {answer['mark']}")


def add_to(app: typer.Typer) -> None:
    """Register everything above, in the order of a working day."""
    for commands, make in (
        (_WAITING_COMMANDS, _waiting_command),
        (_SETTLING_COMMANDS, _settling_command),
        (_STATE_COMMANDS, _plain_command),
    ):
        for name, what, example in commands:
            app.command(name, help=f"{what}\n\nExample: truecell {name} {example}".rstrip())(make(name))
    for command in (status, watch, results, report, history):
        app.command()(command)
    app.add_typer(samples, name="samples")

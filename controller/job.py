"""The job: phases in order, each planned, acquired, estimated and gated; resumable from the store.

Nothing is remembered here that the store does not hold: `execute` walks through the phases from the
first, takes what the store already has, and goes on where it ends. A restart is the same walk.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from controller.acquisition import Acquisition
from controller.cellfile import Cell
from controller.cellfile.job import HandEyePhase, LocalizePhase
from controller.cellfile.job import Phase as PhaseSpec
from controller.faults import GateHeld, OutsideCause
from controller.gates import worst
from controller.knowledge import first_belief
from controller.phases import kind_of
from controller.phases.base import Finding, PhaseContext, PhaseRecord
from controller.phases.reference import reference_excess
from controller.planning.feasibility import refuse_impossible_limits
from controller.planning.steps import Step
from controller.samples import Sample
from controller.store import LINKS_EVENT, Result, Run, Store
from drivers.capabilities import Devices
from drivers.clock import Clock
from estimation.belief import Belief
from estimation.errors import CellFileError, DeviceError, StoreError
from estimation.statistics import Outcome

FIRST_MISSES = 3  # so many first points of a part without a target mean that there is no part
REFERENCES = 2  # known points that are measured again after an interruption


class CellJob:
    """The job of one cell file, against one store and one set of devices."""

    def __init__(self, cell: Cell, devices: Devices, store: Store, clock: Clock, version: str) -> None:
        self._cell, self._store, self._clock, self._version = cell, store, clock, version
        self._devices = devices
        self._arm = cell.robot.arm_model()
        self._acquisition = Acquisition(cell, self._arm, devices, clock)
        self._seed = int(hashlib.sha256(cell.digest.encode()).hexdigest()[:8], 16)  # same job, same plan
        self._run: Run | None = None
        self._progress: dict[str, Any] = {}
        self.publish: Callable[[dict[str, Any]], None] = lambda event: None

    # What the engine calls

    def prepare(self) -> None:
        """Raises CellFileError when a certificate has expired, GateHeld when a limit cannot be met.

        Before a port is opened or anything moves.
        """
        if expired := self._cell.expired(datetime.fromtimestamp(self._clock.utc_s(), UTC).date()):
            raise CellFileError(
                f"Not valid any more: {'; '.join(expired)}",
                "Have it calibrated again and enter the new certificate",
            )
        refuse_impossible_limits(self._cell)

    def begin(self) -> None:
        """Go on with the run that a crash or an abort left open, or open a new one."""
        run = self._store.last_open_run()
        if run is not None and run.cell_digest != self._cell.digest:
            self._store.close_run(run.id, "superseded: the cell file changed")
            run = None
        if run is None:
            self._run = self._store.begin_run(
                self._cell.text, self._cell.digest, self._version, simulated=self._cell.simulated
            )
        else:
            self._run = run
            self.record("resumed", f"Run {run.id} goes on from its last sample")
            self.verify_reference()

    def execute(self, checkpoint: Callable[[], None]) -> None:
        """All phases to the end. Raises Interrupted from `checkpoint`, GateHeld, OutsideCause, CellError."""
        belief = first_belief(self._cell)
        earlier: dict[str, PhaseRecord] = {}
        results = self._store.results(self.run.id)
        renewed = False  # what rests on a result that was measured again must be measured again as well
        for index, spec in enumerate(self._cell.job.phases):
            context: PhaseContext[Any] = PhaseContext(
                self._cell, spec, self._arm, belief, earlier, self._seed
            )
            stored = [result for result in results if result.phase == spec.name]
            renewed = renewed or self._has_expired(spec, stored)
            if stored and not renewed and (stored[-1].verdict == Outcome.OK or spec.kind == "inspect"):
                attempt, last = stored[-1].attempt, stored[-1]
                estimate = last.result["estimate"]
                belief = Belief.from_dict(last.belief) if last.belief is not None else belief
            else:
                attempt = self._next_attempt(stored)
                finding = self._phase(index, context, attempt, checkpoint)
                results.append(self._conclude(spec, attempt, finding, results[-1] if results else None))
                estimate, belief = finding.estimate, finding.belief
            steps = self._steps(spec, attempt)
            earlier[spec.name] = PhaseRecord(
                spec.name, spec.kind, tuple(steps), tuple(self._samples(spec, attempt)), estimate
            )

    def verify_reference(self) -> None:
        """Measure the first plate points of this run again; raises DeviceError if they moved."""
        for step, before in self._references():
            self._tell(phase="reference", activity="acquiring", text="measuring a known point again")
            again = self._acquisition.take(step, None)
            self._store.event(
                "reference", f"step {step.id} measured again", before=before.to_dict(), again=again.to_dict()
            )
            excess = reference_excess(self._cell, self._arm, before, again)
            if excess is not None:
                raise DeviceError(
                    f"The reference point on the plate moved by {excess.moved_m * 1e3:.3f} mm, "
                    f"limit {excess.limit_m * 1e3:.3f} mm",
                    "Laser, plate or robot changed meanwhile: find out what, then Stop, Reset and Start anew",
                )

    def complete(self) -> None:
        """Close the run with the verdict of all its phases."""
        self._acquisition.park()
        outcome = self.outcome().value
        self._record_links()
        self._store.close_run(self.run.id, outcome)
        self._tell(phase=None, activity="completed", outcome=outcome)

    def end(self, state: str) -> None:
        if self._run is not None:
            self._record_links()
            self._store.close_run(self._run.id, state)
            self._run = None

    def _record_links(self) -> None:
        """What the links have seen since the daemon began, with the run that ends now."""
        self._store.event(
            LINKS_EVENT, f"Links of run {self.run.id}", run=self.run.id, **self._devices.counters()
        )

    def status(self) -> dict[str, Any]:
        run = self._run
        return {
            "cell": self._cell.name,
            "run": None if run is None else run.id,
            "progress": dict(self._progress),
        }

    def record(self, kind: str, text: str, **data: Any) -> None:
        self._store.event(kind, text, **data)

    # Phases

    @property
    def run(self) -> Run:
        if self._run is None:
            raise StoreError("No run is open", "Reset and Start")
        return self._run

    def outcome(self) -> Outcome:
        """Of the whole run: the worst last verdict; Undefined while a phase is missing."""
        last = {result.phase: Outcome(result.verdict) for result in self._store.results(self.run.id)}
        names = [spec.name for spec in self._cell.job.phases]
        return worst(last.get(name, Outcome.UNDEFINED) for name in names)

    def _phase(
        self, index: int, context: PhaseContext[Any], attempt: int, checkpoint: Callable[[], None]
    ) -> Finding:
        """One attempt at one phase, from wherever the store says it was left."""
        spec, kind = context.spec, kind_of(context.spec, self._cell.job.phases)
        steps = self._steps(spec, attempt)
        if not steps:
            self._tell(phase=spec.name, activity="planning", attempt=attempt)
            steps = self._extend(index, spec, attempt, [], kind.plan(context))
        while True:
            samples = self._acquire(spec, attempt, steps, checkpoint)
            further = kind.more(context, steps, samples)
            if not further:
                self._tell(phase=spec.name, activity="estimating", attempt=attempt)
                finding = kind.evaluate(context, steps, samples)
                if not finding.verdict.passed and finding.verdict.curable:
                    further = kind.extend(context, steps, samples, finding)
                if not further:
                    break
            steps = self._extend(index, spec, attempt, steps, further)
        return finding

    def _has_expired(self, spec: PhaseSpec, results: Sequence[Result]) -> bool:
        """The last result is older than the cell file lets it be; noted in the audit trail."""
        if not results or not isinstance(spec, HandEyePhase | LocalizePhase):
            return False
        age_s = self._clock.utc_s() - results[-1].utc_s
        if age_s <= spec.expires_s:
            return False
        old_h, held_h = age_s / 3600.0, spec.expires_s / 3600.0
        again = "measured again, with all that rests on it"
        self.record("expired", f"{spec.name} is {old_h:.2f} h old, it held {held_h:.2f} h: {again}")
        return True

    def _next_attempt(self, results: Sequence[Result]) -> int:
        """A new one after each result, but the same again when somebody marked its samples since."""
        if not results:
            return 1
        last = results[-1]
        now = self._store.samples(self.run.id, last.phase, last.attempt)
        marked = {sample.id for sample in now} != set(last.sample_ids)
        return last.attempt if marked else last.attempt + 1

    def _conclude(
        self, spec: PhaseSpec, attempt: int, finding: Finding, calibration: Result | None
    ) -> Result:
        """Store the result; raises GateHeld if the job must not go on with it."""
        verdict = finding.verdict
        ids = [sample.id for sample in self._store.samples(self.run.id, spec.name, attempt)]
        result = self._store.save_result(
            self.run.id,
            spec.name,
            attempt,
            verdict=verdict.outcome.value,
            result={"kind": spec.kind, "estimate": finding.estimate, "verdict": verdict.to_dict()},
            belief=finding.belief.to_dict(),
            sample_ids=ids,
            calibration=None if calibration is None else calibration.content_hash,
        )
        self._tell(phase=spec.name, activity="gated", outcome=verdict.outcome.value, text=verdict.message)
        if not verdict.passed and spec.kind != "inspect":
            raise GateHeld(spec.name, verdict)
        return result

    def _acquire(
        self, spec: PhaseSpec, attempt: int, steps: Sequence[Step], checkpoint: Callable[[], None]
    ) -> list[Sample]:
        """Take what is missing of the steps; a sample counts once the store has it."""
        while missing := self._missing(spec, attempt, len(steps)):  # again: some may be marked meanwhile
            misses = 0
            for done, place in enumerate(missing, start=len(steps) - len(missing) + 1):
                checkpoint()
                step = steps[place]
                sample = self._acquisition.take(step, steps[place - 1] if place else None)
                self._store.add_sample(self.run.id, spec.name, attempt, place, step.kind, sample.to_dict())
                self._tell(
                    phase=spec.name,
                    activity="acquiring",
                    attempt=attempt,
                    step=done,
                    steps=len(steps),
                    text=sample.why,
                )
                misses = 0 if sample.good else misses + 1
                if step.object == "part" and misses == FIRST_MISSES == done:
                    self._mark_for_retake(spec, attempt)
                    raise OutsideCause(
                        "No part: the first three points found nothing", "Put the part in, then Unsuspend"
                    )
        return self._samples(spec, attempt)

    def _missing(self, spec: PhaseSpec, attempt: int, steps: int) -> list[int]:
        """Places in the plan that have no sample, or one that is to be taken again."""
        stored = self._store.samples(self.run.id, spec.name, attempt, include_excluded=True)
        done = {sample.step for sample in stored if sample.mark != "retake"}
        return [place for place in range(steps) if place not in done]

    def _mark_for_retake(self, spec: PhaseSpec, attempt: int) -> None:
        for stored in self._store.samples(self.run.id, spec.name, attempt):
            self._store.retake(stored.id, "no part in the cell", "engine")

    def _extend(
        self, index: int, spec: PhaseSpec, attempt: int, steps: Sequence[Step], further: Sequence[Step]
    ) -> list[Step]:
        numbered = [replace(step, id=f"{len(steps) + i + 1:03d}") for i, step in enumerate(further)]
        plan = [*steps, *numbered]
        self._store.save_plan(
            self.run.id, index, spec.name, attempt, {"steps": [step.to_dict() for step in plan]}
        )
        return plan

    def _steps(self, spec: PhaseSpec, attempt: int) -> list[Step]:
        stored = self._store.plan(self.run.id, spec.name, attempt)
        return [] if stored is None else [Step.from_dict(step) for step in stored.plan["steps"]]

    def _samples(self, spec: PhaseSpec, attempt: int) -> list[Sample]:
        """What the store holds for this attempt, without what was excluded or is to be taken again."""
        stored = self._store.samples(self.run.id, spec.name, attempt)
        return [Sample.from_dict(record.payload) for record in stored]

    def _references(self) -> list[tuple[Step, Sample]]:
        """The first good laser points on the plate in this run, with the steps that took them."""
        for spec in self._cell.job.phases:
            for attempt in (1, 2, 3):
                steps = {step.id: step for step in self._steps(spec, attempt)}
                plate = [
                    s
                    for s in self._samples(spec, attempt)
                    if s.good and s.object == "plate" and s.kind == "laser"
                ]
                if plate:
                    return [(steps[sample.step], sample) for sample in plate[:REFERENCES]]
        return []

    def _tell(self, **progress: Any) -> None:
        self._progress = progress
        self.publish({"event": "progress", **progress})

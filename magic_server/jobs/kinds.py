"""What an engine that chooses between jobs wants to know of each."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class JobKind:
    """How urgent a job is and what it waits for."""

    priority: int
    """The highest goes first."""
    patient: bool = True
    """Whether it waits for workers as long as it takes; else its caller hears that there are
    none."""
    refines: bool = False
    """Whether it is given to workers with the resources that are set aside for merging."""

    @property
    def ahead(self) -> int:
        """How many may be handed over for each that can run: so that a worker has its next job
        at once, but none that takes hours is first in line where an urgent one comes."""
        return 1 if self.refines else 2


KINDS = {
    "localize_image": JobKind(40, patient=False),
    "solve_pose_graph": JobKind(30),
    "settle_pose_graph": JobKind(30),
    "verify_loop": JobKind(20),
    "make_excerpt": JobKind(15, patient=False),
    "append_submaps": JobKind(10, patient=False),
    "merge_submaps": JobKind(0, refines=True),
    "plan_merge": JobKind(0, refines=True),
    "refine_block": JobKind(0, refines=True),
    "refine_block_beside": JobKind(0, refines=True),
    "join_blocks": JobKind(0, refines=True),
}
OTHER = JobKind(20)


def kind_of(job: str) -> JobKind:
    """The kind of a job by its function's name."""
    return KINDS.get(job, OTHER)

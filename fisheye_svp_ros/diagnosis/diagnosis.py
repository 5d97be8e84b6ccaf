"""The answer of a diagnosis: causes, what remains, lenses, decision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fisheye_svp_ros.diagnosis.causes import Cause
from fisheye_svp_ros.diagnosis.checks.turned_boards import TurnedFrame
from fisheye_svp_ros.diagnosis.checks.two_cameras import TwoCameras
from fisheye_svp_ros.diagnosis.checks.two_datasets import TwoDatasets
from fisheye_svp_ros.diagnosis.conclusion import Advice, Conclusion
from fisheye_svp_ros.diagnosis.decision import LensFacts, LensReason
from fisheye_svp_ros.diagnosis.evaluation import (
    MAX_RMS_RATIO,
    Evaluation,
    Figures,
)
from fisheye_svp_ros.diagnosis.findings import Finding
from fisheye_svp_ros.diagnosis.variance_budget import Component, Structure
from fisheye_svp_ros.effects.target_map import BoardMap, board_maps
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import rig_cameras
from fisheye_svp_ros.solve.hand_eye import HandEye
from fisheye_svp_ros.solve.rig_calibration import connected_cameras
from fisheye_svp_ros.solve.rig_checks import has_no_rig


@dataclass(frozen=True)
class Diagnosis(Conclusion):
    """The answer: what to do, what was found, what remains, and the lenses with it.

    noise_px: of a coordinate; causes: confirmed, those in the noise last; trace: what was tried,
    and what came of it; untestable: effects that the data cannot test, and why; gross: outliers by
    frame and landmark, the farthest first; cameras: what each two cameras of a rig say of each
    other; turned: frames whose board is numbered from another end; against: what another data set
    says; hand_eye: where the camera sits on the robot whose poses were given.
    """

    evaluation: Evaluation
    figures: Figures
    noise_px: float
    components: list[Component]
    causes: list[Cause]
    remaining: list[Structure]
    advice: list[Advice]
    lenses: dict[str, Lens]
    trace: list[Finding]
    untestable: dict[str, str]
    gross: list[dict[str, Any]]
    cameras: list[TwoCameras]
    turned: Sequence[TurnedFrame]
    against: TwoDatasets | None = None
    hand_eye: HandEye | None = None

    @property
    def verdict(self) -> str:
        """Whether the simulation is adequate, (partly) explained or unexplained."""
        if self.adequacy.is_misfit:
            return 'unexplained'
        if self.causes or self.decision['lens'].say == 'recalibrate':
            return 'partly_explained' if self.remaining else 'explained'
        # Local offsets of the target alone leave the simulation of the lens adequate.
        rest = {structure.variable for structure in self.remaining} - {'landmark'}
        # Nothing confirms what one frame shows.
        open_effects = self.frames < 2 and self.candidates
        return 'unexplained' if rest or open_effects or self.open_lens is not None else 'adequate'

    @property
    def open_lens(self) -> LensFacts | None:
        """What is known of a lens that is undecided for effects that are not confirmed."""
        lens = self.decision['lens']
        possible = lens.reason is LensReason.EFFECT_POSSIBLE
        return lens.facts if possible and isinstance(lens.facts, LensFacts) else None

    @property
    def offers_extended(self) -> bool:
        """Whether the extended lens is expected to be better than the lens as given.

        One that predicts held-out frames worse than a lens that is off is not.
        """
        refuted = self.file.extended_px > MAX_RMS_RATIO * self.file.given_px
        return self.decision['lens'].say == 'use_extended' or (self.is_lens_off and not refuted)

    @property
    def is_lens_off(self) -> bool:
        """Whether the lens as given is another one than the data show."""
        return self.decision['lens'].say == 'recalibrate'

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return self.evaluation.fixed_model.data.frames

    @property
    def observations(self) -> int:
        """How many observations there are."""
        return len(self.evaluation.problem.observations)

    @property
    def lens(self) -> Lens:
        """The extended lens, of the first camera of a rig."""
        return next(iter(self.lenses.values()))

    @property
    def rig(self) -> tuple[tuple[str, str], Pose] | None:
        """The two cameras of a rig and the first in the second, by the extended lenses."""
        data, rig = self.evaluation.fixed_model.data, self.evaluation.written_model.state.rig
        names = rig_cameras(data.observations.cameras)
        if names is None or has_no_rig(data):
            return None
        first, second = (rig.take(data.observations.cameras.index(name)) for name in names)
        return names, second.inverse().compose(first)

    @property
    def rig_chain(self) -> tuple[tuple[str, ...], tuple[Pose, ...]] | None:
        """The cameras of a rig of any number and each in the next one, by the extended lenses.

        None where no frames hold them all together.
        """
        if self.rig is not None:
            return self.rig[0], (self.rig[1],)
        data, place = self.evaluation.fixed_model.data, self.evaluation.written_model.state.rig
        table = data.observations
        if data.cameras < 3 or has_no_rig(data) or len(connected_cameras(table)) > 1:
            return None
        return table.cameras, tuple(
            place.take(i + 1).inverse().compose(place.take(i)) for i in range(data.cameras - 1)
        )

    def board_maps(self, names: Sequence[str] = ()) -> list[BoardMap]:
        """Return how the target differs from what it is said to be; names: by these effects."""
        state = self.evaluation.fixed_model.state
        terms = [term for term in state.terms if not names or term.name in names]
        return board_maps(self.evaluation.fixed_model.data.views, terms, state.lens)

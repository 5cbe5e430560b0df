"""Refiner: gradient-based local search of grasps, fast, unrolled, or as a training loss."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from lgrasp.differentiable.kinematics import BodyKinematics
from lgrasp.errors import ConfigError
from lgrasp.geometry.rotations import inverse_motion, motion_from_pose, pose_from_motion, so3_exp
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import upload_hand
from lgrasp.hand.model import HandModel
from lgrasp.object.model import ObjectModel
from lgrasp.refine.descent import Descent
from lgrasp.refine.energy import Energies, Matches, intrusion_energies, limit_energy, matching_energies, wrench_energy
from lgrasp.refine.hands import Hands
from lgrasp.refine.links import LinkSolids
from lgrasp.refine.params import LocalSearch
from lgrasp.refine.surface import HandSurface, hand_surface
from lgrasp.refine.target import Target
from lgrasp.refine.volume import upload_target


class Pose(NamedTuple):
    """Hands in the object's internal frame, N of them."""

    R: torch.Tensor
    """Rotation of the base, (N, 3, 3)."""
    t: torch.Tensor
    """Origin of the base [m], (N, 3)."""
    q: torch.Tensor
    """Joint positions [rad or m], (N, K)."""


class Refined(NamedTuple):
    """Result of the fast mode."""

    pose: Pose
    energies: Energies
    """At ``pose``, with new matches, every point within the first reach pulling."""


class Gradient(NamedTuple):
    """Of the total energy by motions of the base about the hand's middle and by the joints."""

    translation: torch.Tensor  # (N, 3) [1/m]
    rotation: torch.Tensor  # (N, 3) [1/rad]
    joints: torch.Tensor  # (N, K)


def clipped(g: Gradient, p: LocalSearch) -> Gradient:
    """A step down, at most the parameters' sizes, per sample."""

    def down(x: torch.Tensor, size: float) -> torch.Tensor:
        scaled = x * size
        return -size * scaled / (1 + (scaled * scaled).sum(-1, keepdim=True)).sqrt()

    return Gradient(
        down(g.translation, p.max_translation_step),
        down(g.rotation, p.max_rotation_step),
        down(g.joints, p.max_joint_step),
    )


def _lost(*hands: torch.Tensor) -> torch.Tensor:
    """NaN of hands (N, ...) that are not finite, 0 of others, (N,)."""
    return torch.cat([x.flatten(1) for x in hands], 1).sum(1) * 0


class Refiner(nn.Module):
    """Moves hands by the gradient of E* (:mod:`lgrasp.refine.energy`) until their surface fits the object's.

    Three modes: :meth:`forward` is fast, keeps no graph and computes in float32 (:mod:`lgrasp.refine.descent`);
    :meth:`unrolled` can be differentiated by the poses that it is given; :meth:`energy` is E* itself, as a loss. What
    becomes of a sample does not depend on the others. It stays on its device and of its type, whatever a module that
    holds it is moved to.

    Args:
        hand: any hand; coupled joints move with their drive.
        target: an object, or a :class:`Target` with surroundings.
        surface: the hand's points; default: :func:`hand_surface`.
    """

    def __init__(
        self,
        hand: HandModel,
        target: ObjectModel | Target,
        params: LocalSearch | None = None,
        *,
        surface: HandSurface | None = None,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
    ) -> None:
        super().__init__()
        for what, given, kinds in (("hand", hand, HandModel), ("object", target, ObjectModel | Target)):
            if not isinstance(given, kinds):
                raise ConfigError(f"{what} is a {type(given).__name__}; what lg.load_{what} gives is accepted")
        if dtype not in (torch.float32, torch.float64):
            raise ConfigError(f"dtype is {dtype}; torch.float32 and torch.float64 are accepted")
        surface = surface or hand_surface(hand)
        self._hand, self._surface, self._device = hand, surface, torch.device(device)
        self._descent: Descent | None = None  # made when first used
        self.params = params or LocalSearch()
        self.target = target if isinstance(target, Target) else Target(target, dtype=dtype, device=device)
        self._bodies = BodyKinematics(hand.tree, dtype=dtype, device=device)
        self._links = LinkSolids(hand, self.target.cloud, self.params.margin, dtype=dtype, device=device)
        self._block = torch.as_tensor(surface.body, dtype=torch.int64, device=device)
        put = partial(torch.as_tensor, dtype=dtype, device=device)
        self._points, self._normals, self._weight = put(surface.points), put(surface.normals), put(surface.weight)
        self._sum = float(surface.weight.sum())
        palmar = surface.weight.reshape(-1) > 0
        self._palmar = torch.as_tensor(palmar.nonzero()[0], device=device)
        self.lower, self.upper = put(hand.tree.joint_lower), put(hand.tree.joint_upper)
        q = put(hand.tree.joint_open)[None]
        R, t = self._bodies(q)
        x = (R[0, self._block] @ self._points.mT).mT + t[0, self._block, None]
        self._middle = x.reshape(-1, 3)[self._palmar].mean(0)  # of the palmar side, base frame

    def __getstate__(self) -> dict[str, Any]:
        """Without what is on a device, for copies; they make it anew."""
        return self.__dict__ | {"_descent": None}

    def forward(
        self, R: torch.Tensor, t: torch.Tensor, q: torch.Tensor, *, rounds: int | None = None, first: int = 0
    ) -> Refined:
        """Refine hands: match and take ``gradient_steps`` steps, in rounds ``first`` to ``rounds``; NaN stay NaN.

        Args:
            rounds: default: the parameters' ``matching_rounds``. Sizes and reach fall along these or the parameters'
                rounds, whichever are more.
            R: rotations of the hand's base in the object's internal frame, (N, 3, 3). t: its origin [m], (N, 3).
            q: joint positions [rad or m], (N, K); outside the limits they are clamped first.

        Raises:
            ConfigError: here and below, tensors of other shapes than these, or of another type than the refiner's.
        """
        self._check(R, t, q)
        with torch.no_grad():
            given, fast = Pose(R.detach(), t.detach(), self._clamped(q.detach())), self.search

            def search(part: Pose) -> Pose:
                at = self._put(part)
                fast.run(at, rounds=rounds, first=first)
                base, q = (torch.as_tensor(x, dtype=t.dtype, device=self._device) for x in at.arrays())
                return Pose(*motion_from_pose(base), q)

            workers = torch.get_num_threads() if self._device.type == "cpu" else 1
            parts = zip(*(x.chunk(workers) for x in given), strict=True)
            with ThreadPoolExecutor(workers) as pool:
                found = list(pool.map(search, [Pose(*part) for part in parts]))
            lost = _lost(*given)
            pose = Pose(*(torch.cat(x) + lost.reshape(-1, *(1,) * (x[0].ndim - 1)) for x in zip(*found, strict=True)))
            return Refined(pose, self.energy(*pose))

    def max_penetration(self, R: torch.Tensor, t: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Depth of the deepest point of hands in anything, or of that in them [m], (N,): negative apart, NaN of hands
        that are not finite."""
        self._check(R, t, q)
        with torch.no_grad():
            depth = torch.as_tensor(self.search.max_penetration(self._put(Pose(R, t, q))), device=self._device)
            return depth + _lost(R, t, q).to(depth)

    @property
    def search(self) -> Descent:
        """The local search of the fast mode."""
        if self._descent is None:
            name = "cpu" if self._device.type == "cpu" else f"cuda:{self._device.index or 0}"
            target = upload_target(self.target.model, self.target.around, name)
            self._descent = Descent(
                upload_hand(self._hand, name), target, self.params, self._surface, self._links.solids
            )
        return self._descent

    def _check(self, R: torch.Tensor, t: torch.Tensor, q: torch.Tensor) -> None:
        """Refuse what is no hands of this refiner; nothing is read from the device."""
        n = len(t) if np.ndim(t) else 0
        for name, x, shape in (("R", R, (n, 3, 3)), ("t", t, (n, 3)), ("q", q, (n, len(self.lower)))):
            given = f"{tuple(x.shape)} of {x.dtype}" if isinstance(x, torch.Tensor) else type(x).__name__
            if given != (accepted := f"{shape} of {self.lower.dtype}"):
                raise ConfigError(f"{name} is {given}; of {n} hands a tensor {accepted} is accepted")

    def _put(self, pose: Pose) -> Hands:
        base = pose_from_motion(pose.R, pose.t)
        return Hands.put(base.cpu().numpy(), pose.q.cpu().numpy(), self.search.device)

    def unrolled(
        self, R: torch.Tensor, t: torch.Tensor, q: torch.Tensor, *, steps: int = 5, matches: Matches | None = None
    ) -> Pose:
        """``steps`` plain clipped gradient steps on one matching; differentiable by R, t and q.

        A step has the largest size of the parameters (``max_*_step``) times the gradient over sqrt(1 + |gradient|^2),
        per sample.

        Args:
            matches: default: those of the poses given.
        """
        self._check(R, t, q)
        matches = matches or self.match(R, t, q)
        pose = Pose(R, t, q)
        for _ in range(steps):
            pose = self._moved(pose, clipped(self._gradient(pose, matches), self.params))
        return pose

    def energy(self, R: torch.Tensor, t: torch.Tensor, q: torch.Tensor, *, matches: Matches | None = None) -> Energies:
        """E* of hands, term by term, differentiable by R, t and q; correspondences are constants: ``matches``, or those
        of these poses with the parameters' first reach."""
        self._check(R, t, q)
        matches = matches or self.match(R, t, q)
        bodies = self._bodies(q)
        x, m = self._placed(R, t, bodies)
        points, normals, kept_out = matching_energies(x, m, matches, self._sum, self.params)
        at = matches.contacts[..., None].expand(-1, -1, 3)
        contacts = x.flatten(1, 2).gather(1, at)
        force = wrench_energy(
            contacts, -self.target.normals(contacts), self.target.com, self.target.radius, self.params
        )
        into, overlap = intrusion_energies(*self._links.distances(matches.intrusions, R, t, *bodies), self.params)
        limits = limit_energy(q, self.lower, self.upper, self.params)
        return Energies(points, normals, force, kept_out + into, overlap, limits)

    @torch.no_grad()
    def match(self, R: torch.Tensor, t: torch.Tensor, q: torch.Tensor, *, reach: float | None = None) -> Matches:
        """Nearest points of the object for every point of the hands, and the contacts that make the net wrench."""
        self._check(R, t, q)
        reach = self.params.reach if reach is None else reach
        bodies = self._bodies(q)
        x, _ = self._placed(R, t, bodies)
        d, n = self.target.nearest(x)
        apart = torch.where(self._weight > 0, d.abs(), torch.inf)
        # the part of each link that is nearest to the object: a surface that fits nowhere else is no error
        least = apart.kthvalue(self.params.touching, dim=2, keepdim=True).values
        pull = self._weight * (apart <= least) * (apart < reach) / (1 + d.abs() / self.params.soft)
        offset = (x * n).sum(-1) - d
        block_d, block_n = self.target.nearest_obstacle(x, d, n)
        block_offset = (x * block_n).sum(-1) - block_d
        return Matches(offset, n, pull, block_offset, block_n, self._contacts(x, d), self._links.match(R, t, *bodies))

    def _contacts(self, x: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        """Farthest points among the nearest of the palmar ones, (N, C); the nearest of all first."""
        p = self.params
        x, d = x.flatten(1, 2)[:, self._palmar], d.flatten(1, 2)[:, self._palmar]
        near = d.topk(max(p.contacts, int(p.nearest * d.shape[1])), largest=False).indices  # (N, n), rising
        x = x.gather(1, near[..., None].expand(-1, -1, 3))
        chosen = [torch.zeros_like(near[:, :1])]
        gap = torch.full_like(x[..., 0], torch.inf)
        for _ in range(p.contacts - 1):
            last = x.gather(1, chosen[-1][..., None].expand(-1, -1, 3))
            gap = gap.minimum(((x - last) ** 2).sum(-1))
            chosen.append(gap.argmax(1, keepdim=True))
        return self._palmar[near.gather(1, torch.cat(chosen, 1))]

    def _placed(
        self, R: torch.Tensor, t: torch.Tensor, bodies: tuple[torch.Tensor, torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Points [m] and normals of the hands in the object's frame, (N, L, P, 3)."""
        body_R, body_t = bodies
        R_block = R[:, None] @ body_R[:, self._block]  # (N, L, 3, 3)
        t_block = (R[:, None] @ body_t[:, self._block, :, None])[..., 0] + t[:, None]
        turned = R_block.mT
        return self._points @ turned + t_block[:, :, None], self._normals @ turned

    def _gradient(self, pose: Pose, matches: Matches) -> Gradient:
        if torch.is_inference_mode_enabled():
            raise ConfigError("unrolled steps need gradients: torch.inference_mode() is refused, no_grad() accepted")
        with torch.enable_grad():
            R, t, q = (x if x.requires_grad else x.detach().requires_grad_() for x in pose)
            total = self.energy(R, t, q, matches=matches).total.sum()
            by_R, by_t, by_q = torch.autograd.grad(total, [R, t, q], create_graph=True)
            arm = t - self.middle(R, t)
            rotation = torch.linalg.cross(R, by_R, dim=1).sum(2) + torch.linalg.cross(arm, by_t)
        return Gradient(by_t, rotation, by_q)

    def middle(self, R: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        """Middle of the palmar side of open hands [m], (N, 3): what they are turned about."""
        return t + R @ self._middle

    def _moved(self, pose: Pose, by: Gradient) -> Pose:
        """The poses after a translation, a rotation about the hand's middle, and a motion of the joints."""
        centre = self.middle(pose.R, pose.t)
        T = so3_exp(by.rotation)
        t = centre + by.translation + (T @ (pose.t - centre)[..., None])[..., 0]
        return Pose(T @ pose.R, t, self._clamped(pose.q + by.joints))

    def _clamped(self, q: torch.Tensor) -> torch.Tensor:
        return q.maximum(self.lower).minimum(self.upper)


def object_pose(R: torch.Tensor, t: torch.Tensor) -> np.ndarray:
    """T_hand_object of the object's internal frame, device poses (N, 7), of hands in that frame."""
    return pose_from_motion(*inverse_motion(R, t)).cpu().numpy()


def table_pose(table: GraspTable, device: str) -> Pose:
    """Hands of grasps in the object's internal frame: inverse of :func:`object_pose`."""
    motion = motion_from_pose(torch.as_tensor(table.pose, device=device))
    return Pose(*inverse_motion(*motion), torch.as_tensor(table.q, device=device))

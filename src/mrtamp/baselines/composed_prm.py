"""Composed PRM*: an asymptotically optimal roadmap in the composite space of every mode (Hartmann et al., 2025).

Batches of uniform composite configurations and of jointly sampled transitions are added; then the cheapest path over
all modes is searched, validated lazily.  What its authors found to help is there and can be switched off: informed
sampling, shortcutting, and drawing modes near the goal before the first plan.  Modes are continuous here, grasps and
placements included: each is discovered by the transition that leads to it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from mrtamp.baselines.anytime import Anytime
from mrtamp.baselines.composite import CompositeRoadmap, Layer
from mrtamp.baselines.multimodal import Crossing, Found, Multimodal
from mrtamp.guidance import Choice
from mrtamp.informed import ellipsoid_sample
from mrtamp.mechanisms import check_without
from mrtamp.modes import goal_mode
from mrtamp.plan import Plan, Segment, Transition
from mrtamp.problem import MrtampError, Problem
from mrtamp.tensor_tree import At
from mrtamp.transitions.candidate import Candidate
from mrtamp.transitions.choices import known_candidates, new_candidates
from mrtamp.transitions.projection import uniform_configurations

_VISIT = 0.3
"""How much farther from the goal a mode seems for the square root of its visits."""
_TIE = 0.25
_TRIES = 4
"""Configurations of the passive robots that are tried per sampled transition."""
_ROUNDS = 40
"""Draws per configuration that is asked for."""
_ENOUGH = 8
"""Candidates of a transition that are known in a mode before new ones are sampled less often."""
_BIAS = 0.9
"""How often a mode is drawn for how near the goal it seems."""
_GROWN = 1.1
"""Growth of the number of crossings after which those that cannot pay any more are forgotten."""
_EPS = 1e-9
_WORTH = 0.005
"""Relative gain over the last path that is worth another search, and shortening what it finds."""


@dataclass(frozen=True)
class ComposedOptions:
    """Settings of the planner.

    batch : composite configurations per iteration.  transitions : crossings per iteration.
    seeds : IK seeds per call of the transition sampler.
    shortcuts : proposals of shortening per plan.
    without : names of what is switched off, see `mrtamp.mechanisms.MECHANISMS_OF`.
    """

    batch: int = 40
    transitions: int = 12
    seeds: int = 48
    shortcuts: int = 600
    without: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        check_without("composed-prm", self.without)


class ComposedPRM(Anytime):
    """Plans in the composite configuration space of all robots.

    Attributes
    ----------
    graph : the layers and the crossings between them.
    """

    def __init__(self, problem: Problem, *, seed: int = 0, options: ComposedOptions | None = None) -> None:
        self.options = options or ComposedOptions()
        super().__init__(problem, seed, factored_cache=self._uses("factored-cache"))
        self.roadmap = CompositeRoadmap(self.roadmaps, self.validity, problem.cost)
        self.trouble = self.roadmap.trouble
        self.graph = Multimodal(self.roadmap)
        self._along: list[Layer] = []
        self._final: set[Layer] = set()
        self._searched = np.inf
        self._pruned = 1
        self._known_bounds = (-1, np.zeros(0))
        layer = self.graph.layer(self.root)
        self._enter(self.graph.cross(tuple(self.start.values()), None, layer))

    def _uses(self, mechanism: str) -> bool:
        return mechanism not in self.options.without

    @property
    def nodes(self) -> int:
        """Composite vertices."""
        return len(self.roadmap.at)

    def _iterate(self) -> None:
        self._sample_interior()
        for _ in range(self.options.transitions):
            if self._late():
                return
            self._sample_crossing()
        self.graph.refresh()
        if self.best is not None and len(self.graph.crossings) > _GROWN * self._pruned:
            self.graph.prune(max(self._searched, self.cost))
            self._pruned = len(self.graph.crossings)
            self._along = [layer for layer in self._along if layer.mode.key in self.graph.layers]
        # One search builds on shortened plans; the other finds plans that shortening may make more of.
        self._search(anew=True)
        if self.graph.adopted:
            self._search(anew=False)

    def _search(self, *, anew: bool) -> None:
        """Search until a path is found that is valid, or none is cheaper."""
        while not self._late():
            worth = _WORTH if self._uses("refinement") else _EPS
            below = (1 - worth) * (self._searched if anew else self.cost)
            found = self.graph.cheapest(below, self._late, anew=anew)
            if found is None:
                return
            plan = self._judged(found)
            if plan is not None:
                if anew:
                    self._searched = found.cost
                self._keep(found, plan)
                return

    # -- interior -------------------------------------------------------------------------------------------------

    def _sample_interior(self) -> None:
        """Uniform configurations for all modes, and after the first plan informed ones for the modes along it."""
        informed = self.best is not None and self._uses("informed-sampling")
        uniform = self.options.batch // 2 if informed else self.options.batch
        self.roadmap.share([i for i in (self._uniform() for _ in range(uniform)) if i is not None])
        if informed:
            for _ in range(self.options.batch - uniform):
                self._informed()

    def _uniform(self) -> int | None:
        """A composite configuration that is free of the static world and of the robots among each other."""
        q = []
        for name, roadmap in self.roadmaps.items():
            x = self._free_configuration(name)
            if x is None:
                return None
            q.append((roadmap, x))
        for (g, a), (h, b) in itertools.combinations(q, 2):
            if self.collision.first_hit(g.name, a[None], None, h.name, b[None], None) >= 0:
                return None
        return self.roadmap.add(self.roadmap.vertices([x for _, x in q]))

    def _free_configuration(self, robot: str) -> np.ndarray | None:
        world = self.roadmaps[robot].world
        for _ in range(_ROUNDS):
            q = uniform_configurations(world.tool, self.rng, 1)
            if world.first_hit(world.rows(q, None, {})) < 0:
                return q[0]
        return None

    def _informed(self) -> None:
        """A configuration by way of which one motion of the best plan may become cheaper, for its mode alone."""
        assert self.best is not None
        segment = self.best.segments[int(self.rng.integers(len(self.best.segments)))]
        q = np.concatenate(list(segment.q.values()), axis=1)
        if len(q) < 3:
            return
        i, j = sorted(self.rng.choice(len(q), size=2, replace=False).tolist())
        steps = self.roadmap.distance(q[i:j], q[i + 1 : j + 1])
        longest = float(steps.sum())
        scale = self.problem.cost.makespan + self.problem.cost.path_length
        for _ in range(_ROUNDS):
            x = np.concatenate(
                [
                    ellipsoid_sample(a, b, longest / scale, self.rng)
                    for a, b in zip(self.roadmap.parts(q[i]), self.roadmap.parts(q[j]), strict=True)
                ]
            )
            if not self._within_limits(x):
                continue
            if self.roadmap.distance(q[i], x) + self.roadmap.distance(x, q[j]) < longest:
                layer = self.graph.layer(segment.mode)
                vertex = self.roadmap.add(self.roadmap.vertices(self.roadmap.parts(x)))
                if self.roadmap.stands(segment.mode, vertex):
                    layer.add(vertex)
                return

    def _within_limits(self, q: np.ndarray) -> bool:
        chains = [g.world.chain for g in self.roadmaps.values()]
        parts = self.roadmap.parts(q)
        return all(np.all(x >= c.lower) and np.all(x <= c.upper) for c, x in zip(chains, parts, strict=True))

    # -- transitions ----------------------------------------------------------------------------------------------

    def _sample_crossing(self) -> None:
        """Draw a mode, one of its transitions, and where the passive robots are when it happens."""
        biased = self._uses("goal-bias") and self.rng.random() < _BIAS
        layer = self._draw_layer(biased)
        layer.visits += 1
        self.guidance.visit(layer.mode)
        choice = self._draw_choice(layer, biased)
        if choice is None:
            return
        known = known_candidates(self.sampler, layer.mode, choice)
        if len(known) < _ENOUGH or self.rng.random() < 0.3:
            known = [*new_candidates(self.sampler, layer.mode, choice, self.options.seeds), *known]
        crossed = bool(known) and self._cross(layer, known[int(self.rng.integers(len(known)))])
        self.guidance.record(layer.mode, choice, crossed)

    def _draw_layer(self, biased: bool) -> Layer:
        """A mode to go on from: any one, or (biased) one that is near the goal, or on the way to it.

        Biased draws are, before there is a way to the goal, of what is optimistically nearest to it; later in turn of
        what the best plan goes through, of what leads nowhere yet and of all.
        """
        layers = list(self.graph.layers.values())
        if biased and not self.graph.ends:
            return min(layers, key=lambda x: self.guidance.remaining(x.mode) + _VISIT * np.sqrt(x.visits))
        if biased:
            open_ended = [x for x in layers if x not in self._final]
            kind = int(self.rng.integers(3))
            drawn = [x for x in self._along if x not in self._final] if kind == 0 else []
            drawn = [x for x in open_ended if not self.graph.exits[x]] if kind == 1 else drawn
            layers = drawn or open_ended or layers
        return layers[int(self.rng.integers(len(layers)))]

    def _draw_choice(self, layer: Layer, biased: bool) -> Choice | None:
        if biased:
            proposals = self.guidance.proposals(layer.mode)
            best = [c for score, c in proposals if score <= proposals[0][0] + _TIE]
        else:
            best = self.guidance.enabled(layer.mode)
        return best[int(self.rng.integers(len(best)))] if best else None

    def _cross(self, layer: Layer, candidate: Candidate) -> bool:
        """Add the crossing of a candidate if there is a composite configuration for it that is free in both modes."""
        transition = Transition((candidate.action,))
        mode = layer.mode.after(transition)
        for _ in range(_TRIES):
            at = self._around(layer, candidate)
            if at is None or (self._uses("informed-sampling") and not self._may_pay(layer, at)):
                continue
            vertex = self.roadmap.add(at)
            if not (self.roadmap.stands(layer.mode, vertex) and self.roadmap.stands(mode, vertex)):
                continue
            self._discover(mode, layer.mode)
            cost = self.problem.cost.of_changes([candidate.kind])
            chains = self._chains(at, candidate)
            self._enter(self.graph.cross(at, layer, self.graph.layer(mode), transition, cost, chains))
            return True
        return False

    def _around(self, layer: Layer, candidate: Candidate) -> At | None:
        """Where all robots are: the active ones as the candidate says, the others anywhere.

        Two in three times they stay as they came into the mode, or are on the straight way from there to what they may
        do next.
        """
        entries = self.graph.entries[layer]
        entry = self.roadmap.at[entries[int(self.rng.integers(len(entries)))].vertex]
        out = []
        for name, here in zip(self.names, entry, strict=True):
            if name in candidate.at:
                out.append(candidate.at[name])
                continue
            kind = int(self.rng.integers(3))
            v = here if kind == 0 else self._on_the_way(layer, name, here) if kind == 1 else None
            if v is None:
                q = self._free_configuration(name)
                if q is None:
                    return None
                v = self.roadmaps[name].add_vertex(q, connect=False)
            out.append(v)
        return tuple(out)

    def _on_the_way(self, layer: Layer, robot: str, here: int) -> int | None:
        """A vertex between where a robot is and one of its known next transitions or its end; None: it has none."""
        ahead = [self.goal[robot]] if robot in self.goal else []
        for choice in self.guidance.enabled(layer.mode):
            if robot in choice.robots:
                ahead += [c.at[robot] for c in known_candidates(self.sampler, layer.mode, choice)]
        if not ahead:
            return None
        roadmap = self.roadmaps[robot]
        there = ahead[int(self.rng.integers(len(ahead)))]
        exits = roadmap.exits.get(here, [here])
        a, b = roadmap.q[exits[-1]], roadmap.q[roadmap.exits.get(there, [there])[-1]]
        return roadmap.add_vertex(a + self.rng.random() * (b - a), connect=False)

    def _chains(self, at: At, candidate: Candidate) -> list[list[At]]:
        """Ways out of a transition along the approach motions of its robots: one robot at a time, then the other."""
        index = {r: i for i, r in enumerate(self.names)}

        def moved(base: At, robot: str, v: int) -> At:
            return (*base[: index[robot]], v, *base[index[robot] + 1 :])

        out = []
        for robot, v in candidate.at.items():
            for chain in self.roadmaps[robot].chains(v):
                way = [moved(at, robot, w) for w in chain]
                for other, u in candidate.at.items():
                    for follow in self.roadmaps[other].chains(u) if other != robot else []:
                        way += [moved(way[-1], other, w) for w in follow]
                out.append(way)
        return out

    def _may_pay(self, layer: Layer, at: At) -> bool:
        """Whether a plan through a composite configuration in a mode may be cheaper than the best one."""
        if self.best is None:
            return True
        vertex = self.roadmap.q(self.roadmap.add(at))
        entries = self.graph.entries[layer]
        forward = self._bounds()
        q = self.roadmap.q([e.vertex for e in entries])
        numbers = np.array([e.number for e in entries])
        known = numbers < len(forward)
        if not known.any():
            return True
        reach = forward[numbers[known]] + self.roadmap.distance(q[known], vertex)
        ends = self.roadmap.q([self.graph.crossings[i].vertex for i in self.graph.ends])
        return bool(reach.min() + self.roadmap.distance(ends, vertex).min() < self.cost)

    def _bounds(self) -> np.ndarray:
        """Lower bounds of the cost from the start to every crossing that was there when this iteration began."""
        if self._known_bounds[0] != self.iteration:
            self._known_bounds = (self.iteration, self.graph.bounds()[0])
        return self._known_bounds[1]

    # -- ends -----------------------------------------------------------------------------------------------------

    def _enter(self, crossing: Crossing) -> None:
        """Where a mode satisfies the goal, let the plan end: robots without a prescribed end stay where they are."""
        layer = crossing.after
        assert layer is not None
        if not goal_mode(self.problem, layer.mode, self.validity.X_WB):
            return
        self._final.add(layer)
        entry = self.roadmap.at[crossing.vertex]
        at = tuple(self.goal.get(r, v) for r, v in zip(self.names, entry, strict=True))
        if at == entry and len(self.goal) < len(self.names):
            self.graph.cross(at, layer, None)
            return
        ends = {self.graph.crossings[i].vertex for i in self.graph.ends if self.graph.crossings[i].before is layer}
        for end in (at, tuple(self.goal.get(r, self.home[r]) for r in self.names)):
            if self.roadmap.add(end) not in ends:
                ends.add(self.roadmap.add(end))
                self.graph.cross(end, layer, None)

    # -- plans ----------------------------------------------------------------------------------------------------

    def _judged(self, found: Found) -> Plan | None:
        """The plan of a path if the judge accepts it; else what is wrong with it is blocked."""
        segments = self.graph.segments(found)
        plan = self.incumbent.plan(segments, found.transitions)
        report = self.incumbent.judge(plan)
        if report.ok:
            return plan
        for violation in report.violations:
            if violation.kind not in ("collision", "contact") or violation.segment is None:
                raise MrtampError(f"the planner produced an illegal plan; please report this: {violation}")
            path, step = found.paths[violation.segment], violation.step or 0
            layer = found.crossings[violation.segment].after
            assert layer is not None
            if step + 1 < len(path):
                layer.block(path[step], path[step + 1])
            else:
                self.graph.ban(found.crossings[violation.segment + 1])
            if step >= len(path) - 2 and (violation.fraction or 0.0) > 0.999:
                self.graph.ban(found.crossings[violation.segment + 1])
        return None

    def _keep(self, found: Found, plan: Plan) -> None:
        """Offer a plan, and what shortcuts make of it: that goes back into the graph."""
        if self._offer(plan):
            self._along = list(dict.fromkeys(c.after for c in found.crossings if c.after is not None))
        shortened = self._shortened(plan, self.options.shortcuts) if self._uses("refinement") else None
        if shortened is None or not self._offer(shortened):
            return
        self._along = [self.graph.layer(s.mode) for s in shortened.segments]
        paths = [self._vertices(s) for s in shortened.segments]
        self.graph.adopt([s.mode for s in shortened.segments], paths, shortened.transitions)

    def _vertices(self, segment: Segment) -> list[int]:
        """The composite vertices of a segment's waypoints, made where there are none."""
        rows = []
        for name, q in segment.q.items():
            roadmap = self.roadmaps[name]
            own: list[int] = []
            for k, x in enumerate(q):
                known = own[-1] if k and np.array_equal(x, q[k - 1]) else roadmap.find(x)
                own.append(roadmap.add_vertex(x, connect=False) if known is None else known)
            rows.append(own)
        return [self.roadmap.add(at) for at in zip(*rows, strict=True)]

"""Attacks of several kinds in one compiled program: which of them acts is data."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from holdfast.loop import Scenario
from holdfast.parts import Attack
from holdfast.records import Injection, Knowledge


class Nothing(Attack):
    """Nobody attacks."""

    channels: Array

    def init(self, key: PRNGKeyArray, known: Knowledge) -> tuple:
        """Nothing to remember."""
        return ()

    def step(self, state: tuple, known: Knowledge) -> tuple[tuple, Injection]:
        """Zeros."""
        zeros = jnp.zeros_like(known.u), jnp.zeros_like(known.y), jnp.zeros_like(self.channels)
        return state, Injection(*zeros)


class Choice(Attack):
    """Number ``which`` of ``attacks``; the others stand beside it so that shapes agree."""

    attacks: tuple[Attack, ...]
    which: Int[Array, ""]

    def init(self, key: PRNGKeyArray, known: Knowledge) -> Any:
        """The states of all, each with the key that it would have alone."""
        return tuple(attack.init(key, known) for attack in self.attacks)

    def step(self, state: Any, known: Knowledge) -> tuple[Any, Injection]:
        """The step of the chosen one."""
        switches = jax.eval_shape(lambda: [a.step(s, known)[1] for a, s in self._with(state)])
        thrown = any(injection.switch is not None for injection in switches)

        def act(number: int):
            def step(states):
                after, injection = self.attacks[number].step(states[number], known)
                switch = injection.switch
                if thrown and switch is None:
                    switch = jnp.asarray(0, jnp.int32)
                injection = Injection(injection.u, injection.y, injection.d, switch)
                return (*states[:number], after, *states[number + 1 :]), injection

            return step

        return jax.lax.switch(self.which, [act(i) for i in range(len(self.attacks))], state)

    def _with(self, state: Any) -> zip:
        return zip(self.attacks, state, strict=True)


def together(scenarios: Sequence[Scenario]) -> list[Scenario]:
    """The scenarios with attacks that have the same structure, so that one program serves all.

    Where all have the same kinds already they are returned as they are. The first attack of
    each is chosen among the kinds of all first attacks, and so on; a run has the same attacks,
    key by key, as alone.
    """
    places = max((len(s.attacks) for s in scenarios), default=0)
    columns = [[_at(s, place) for s in scenarios] for place in range(places)]
    chosen = [_chosen(column) for column in columns]
    found = []
    for number, scenario in enumerate(scenarios):
        attacks = tuple(column[number] for column in chosen)
        found.append(
            Scenario(
                scenario.plant, scenario.x0, scenario.monitor, scenario.controller, attacks,
                scenario.enforcement,
            )
        )  # fmt: skip
    return found


def _at(scenario: Scenario, place: int) -> Attack:
    if place < len(scenario.attacks):
        return scenario.attacks[place]
    return Nothing(jnp.zeros(len(scenario.plant.attacks)))


def _chosen(attacks: Sequence[Attack]) -> list[Attack]:
    """Each attack, among one of every structure that occurs where there are several."""
    structures = [structure_of(attack) for attack in attacks]
    kinds = list(dict.fromkeys(structures))
    if len(kinds) == 1:
        return list(attacks)
    examples = [attacks[structures.index(kind)] for kind in kinds]
    found: list[Attack] = []
    for attack, structure in zip(attacks, structures, strict=True):
        number = kinds.index(structure)
        among = (*examples[:number], attack, *examples[number + 1 :])
        found.append(Choice(among, jnp.asarray(number, jnp.int32)))
    return found


def structure_of(part: Any) -> tuple:
    """All of a part but the values of its arrays: parts with the same share a program."""
    leaves, tree = jax.tree.flatten(part)
    shapes = (
        (leaf.shape, str(leaf.dtype)) if isinstance(leaf, jax.Array | np.ndarray) else leaf
        for leaf in leaves
    )
    return (tree, *shapes)

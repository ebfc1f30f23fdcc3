"""A network that is shared between transmitters, and between combinations of them, for passive radar.

Every transmitter's fields pass, with those of the track, through the same layers. A combination is scored by the sum of
its members' features, together with their mean over the pool, so that scores do not depend on how transmitters are
numbered. To each score is added what the combination promises, where the observation tells (`promised_scans`):
untrained, the network's most probable action is the greedy one, and it learns where to deviate.

    score(c) = w · tanh(Σ_{i ∈ c} U e_i + V mean_i e_i + q log(1 + s_c)) − s_c,      s_c = sharpness · log promise of c

Where an action is a score per transmitter, c is a transmitter alone and its promise that of the best combination with
it. How the receiver flies, where it moves, comes from the mean features.
Source: sums over exchangeable members as in Zaheer et al., "Deep Sets", NeurIPS 2017.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from passive_env.actions import LEADS_DEG, Combinations
from passive_env.radar_observation import RadarObservation
from passive_env.truth import RadarTruthObservation

NETWORK = "per_transmitter"
"""Its name in presets."""

LEAD_PREFERENCE = 5.0
"""Log odds of an untrained network's lead pursuit to each other course."""


def network_settings(scenario: Any, truth: RadarTruthObservation | None = None) -> dict[str, Any]:
    """Settings `layout` of a `TransmitterPolicy` for a scenario.

    Args:
        scenario: what is acted in.
        truth: what the critic is shown besides, behind the observation.
    Raises:
        ValueError: a scenario whose observation has no fields per transmitter.
    """
    observation = scenario.make_observation()
    if not isinstance(observation, RadarObservation):
        raise ValueError(
            f"network = {NETWORK!r}: {type(scenario).__name__} observes no transmitters one by one; leave it out"
        )
    discrete = isinstance(scenario.make_actions(), Combinations)
    return {
        "shared": observation.shared, "per_transmitter": observation.per_transmitter, "pool": scenario.pool,
        "promised": observation.promised, "combinations": scenario.combinations.tolist(),
        "moves": int(scenario.moves) * (len(LEADS_DEG) if discrete else 1), "discrete": discrete,
        "truth_shared": 0 if truth is None else truth.shared, "truth": 0 if truth is None else len(truth.fields),
    }  # fmt: skip


class TransmitterPolicy(ActorCriticPolicy):
    """Actor and critic, each with layers that all transmitters share.

    Args:
        layout: as `network_settings` tells.
        sharpness: how much a promised error counts that is larger by a factor e.
        the others: as of `ActorCriticPolicy`.
    """

    def __init__(self, *arguments: Any, layout: dict[str, Any], sharpness: float = 20.0, **settings: Any):
        self.layout, self.sharpness = layout, sharpness  # before the base class, which builds the networks
        self.truth_size = layout["truth"]
        super().__init__(*arguments, **settings)

    def _build_mlp_extractor(self) -> None:
        sizes: Any = self.net_arch
        self.mlp_extractor: Any = SharedLayers(self.layout, list(sizes), self.activation_fn, self.sharpness)
        self.mlp_extractor.to(self.device)

    def flown(self) -> tuple[Any, dict[str, Any], dict[str, torch.Tensor]]:
        """Class, settings and the actor's parameters of a policy that acts alike and is not shown the truth."""
        actor = {
            name: value
            for name, value in self.state_dict().items()
            if not name.startswith(("mlp_extractor.critic.", "value_net."))
        }
        return TransmitterPolicy, {"layout": {**self.layout, "truth": 0, "truth_shared": 0}}, actor

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.action_net = nn.Identity()  # the shared layers end in scores
        self.mlp_extractor.begin_with_promises()
        make: Any = self.optimizer_class
        self.optimizer = make(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)


class SharedLayers(nn.Module):
    """From observations to scores [e, a] and to the critic's features.

    Attributes:
        sizes: units of the hidden layers.
        sharpness: as of `TransmitterPolicy`.
    """

    members: torch.Tensor  # [c, n], 1 of those in a combination

    def __init__(self, layout: dict[str, Any], sizes: list[int], activation: type[nn.Module], sharpness: float):
        super().__init__()
        self._shared, self._own, self._pool = layout["shared"], layout["per_transmitter"], layout["pool"]
        self._promised, self._discrete, self._moves = layout["promised"], layout["discrete"], layout["moves"]
        self.sizes, self.sharpness, width = sizes, sharpness, sizes[-1]
        self._truth, self._truth_shared = layout["truth"], layout["truth_shared"]
        more = (self._truth - self._truth_shared) // self._pool
        self.actor = _Encoder(self._shared, self._own, sizes, activation)
        self.critic = _Encoder(self._shared + self._truth_shared, self._own + more, sizes, activation)
        self.member, self.context = nn.Linear(width, width, bias=False), nn.Linear(width, width)
        self.promise, self.score = nn.Linear(1, width, bias=False), nn.Linear(width, 1)
        self.move, self.bend = nn.Linear(width, max(self._moves, 1)), activation()
        members = np.zeros((len(layout["combinations"]), self._pool), dtype=np.float32)
        np.put_along_axis(members, np.array(layout["combinations"]), 1.0, axis=1)
        self.register_buffer("members", torch.from_numpy(members), persistent=False)
        self.latent_dim_pi = self._moves + (len(members) if self._discrete else self._pool)
        self.latent_dim_vf = 2 * width

    def begin_with_promises(self) -> None:
        """Let scores be those of the promises alone; a receiver that moves begins with lead pursuit, or straight on."""
        for layer in (self.score, self.move):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        if self._discrete and self._moves:
            nn.init.constant_(self.move.bias[self._moves // 2 : self._moves // 2 + 1], LEAD_PREFERENCE)

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The actor's and the critic's of observations [e, d]."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Rates and scores [e, a] of observations [e, d]."""
        each = self.actor(*self._parts(features))
        mean = each.mean(dim=1)
        hidden = self.member(each)
        if self._discrete:
            hidden = self.members @ hidden
        hidden = hidden + self.context(mean)[:, None]
        promise = self._promises(features)
        if promise is not None:
            hidden = hidden + self.promise(torch.log1p(promise)[..., None])
        score = self.score(self.bend(hidden))[..., 0]
        if promise is not None:
            score = score - promise
        return torch.cat([self.move(mean), score], dim=1) if self._moves else score

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """The critic's features [e, 2 m] of observations [e, d]."""
        each = self.critic(*self._with_truth(features))
        return torch.cat([each.mean(dim=1), each.amax(dim=1)], dim=1)

    def _parts(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What is common [e, g] and every transmitter's own [e, n, f]."""
        end = self._shared + self._pool * self._own
        own = features[:, self._shared : end].reshape(len(features), self._pool, self._own)
        return features[:, : self._shared], own

    def _with_truth(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The same with what only a critic is shown, whose fields of one kind stand together for all transmitters."""
        shared, own = self._parts(features)
        if not self._truth:
            return shared, own
        truth = features[:, -self._truth :]
        each = truth[:, self._truth_shared :].unflatten(1, (-1, self._pool)).swapaxes(1, 2)
        return torch.cat([shared, truth[:, : self._truth_shared]], dim=1), torch.cat([own, each], dim=2)

    def _promises(self, features: torch.Tensor) -> torch.Tensor | None:
        """Sharpness times log promises of what is scored: combinations [e, c] or transmitters [e, n]."""
        if not self._promised:
            return None
        begin = self._shared + self._pool * self._own
        promise = self.sharpness * features[:, begin : begin + self._promised]
        if self._discrete:
            return promise
        without = torch.where(self.members.T > 0.0, 0.0, torch.inf)
        return (promise[:, None] + without).amin(dim=2)


class _Encoder(nn.Module):
    """Features [e, n, m] of every transmitter from what is common [e, g] and its own [e, n, f]."""

    def __init__(self, shared: int, own: int, sizes: list[int], activation: type[nn.Module]):
        super().__init__()
        self.common, self.own = nn.Linear(shared, sizes[0]), nn.Linear(own, sizes[0], bias=False)
        layers: list[nn.Module] = [activation()]
        for before, after in itertools.pairwise(sizes):
            layers += [nn.Linear(before, after), activation()]
        self.rest = nn.Sequential(*layers)

    def forward(self, shared: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
        return self.rest(self.common(shared)[:, None] + self.own(own))

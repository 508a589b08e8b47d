# %% [markdown]
# # A tour of sparse training
#
# You want to see what sparse training does. Three agents learn to swing up a pendulum: a dense one,
# one with a fixed random tenth of its connections, and one whose tenth moves while it learns. Then
# come what is left of the network, how many parameters a return needs, and the policy as a C file.
# It takes two minutes of one core.
#
# Open this file as a notebook (VS Code and Jupyter with jupytext read its cells), or run it:
#
#     pip install -e ".[zoo]"
#     python examples/tour.py
#
# As a script it saves its figures as tour_*.png.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_sparse import SAC, SparsityCallback
from sb3_sparse.export import export_policy

STEPS = 5000  # environment steps of each training
EPISODES = 20  # of each evaluation


# %% [markdown]
# ## Train
#
# A sparse agent needs `"SparsePolicy"` and a `sparsity`, the removed fraction. Without a callback
# the mask stays as it was drawn ("static"); `SparsityCallback("rigl")` drops the weakest
# connections every so often, and grows those whose gradients are largest.


# %%
def trained(sparsity, callback=None):
    """A model after training; the returns of its episodes are in its environment."""
    model = SAC(
        "SparsePolicy",
        "Pendulum-v1",
        learning_rate=1e-3,
        learning_starts=200,
        policy_kwargs=dict(net_arch=[256, 256], sparsity=sparsity),
        seed=0,
    )
    return model.learn(STEPS, callback=callback)


def episodes(model):
    """Returns of the episodes of training, in their order."""
    monitor = model.get_env().envs[0]
    assert isinstance(monitor, Monitor)
    return monitor.get_episode_rewards()


rigl = SparsityCallback("rigl", update_interval=200)
agents = {
    "dense": trained(0.0),
    "static, 90 %": trained(0.9),
    "RigL, 90 %": trained(0.9, rigl),
}

figure, axes = plt.subplots(figsize=(6, 3.5))
for name, model in agents.items():
    returns = episodes(model)
    axes.plot(200 * np.arange(1, len(returns) + 1), returns, label=name)
axes.set(xlabel="environment steps", ylabel="return of an episode", title="Pendulum-v1, one seed")
axes.legend()
figure.savefig("tour_learning.png", bbox_inches="tight")

# %% [markdown]
# ## Look inside
#
# The report gives each layer's connections. ERK, the usual distribution, spares small layers: the
# actor's first one keeps far more than a tenth.

# %%
sparse = agents["RigL, 90 %"]
print(sparse.policy.sparsity_report())

# %% [markdown]
# The mask says which connections are there. RigL has moved some of them: the static agent, with the
# same seed, still has the mask that both began with.


# %%
def connections(model):
    """Whether each connection from the actor's first to its second hidden layer is there."""
    return model.policy.state_dict()["actor.latent_pi.2.weight_mask"].numpy()


figure, axes = plt.subplots(1, 2, figsize=(8, 4), sharey=True)
for place, name in zip(axes, ("static, 90 %", "RigL, 90 %"), strict=True):
    place.imshow(connections(agents[name]), cmap="Greys", interpolation="nearest")
    place.set(title=name, xlabel="unit of the first hidden layer")
axes[0].set(ylabel="unit of the second")
figure.savefig("tour_masks.png", bbox_inches="tight")
fixed, moved = (connections(agents[name]) for name in ("static, 90 %", "RigL, 90 %"))
share = 1 - (fixed & moved).sum() / fixed.sum()
print(f"of the connections of this layer, RigL has moved {share:.0%}")

# %% [markdown]
# ## Return against parameters
#
# How sparse may it be? One more agent has a fiftieth of its connections. One seed shows what to
# look at and decides nothing: `sb3-sparse study` compares methods over seeds, with intervals.

# %%
agents["RigL, 98 %"] = trained(0.98, rigl)
points = {}
for name, model in agents.items():
    mean, std = evaluate_policy(model, model.get_env(), n_eval_episodes=EPISODES)
    layers = [one for one in model.policy.sparsity_report().layers if one.network == "actor"]
    parameters = sum(layer.parameters for layer in layers)
    points[name] = (parameters, float(mean))
    print(f"{name}: return {mean:.0f} ± {std:.0f} with {parameters:,} parameters in the actor")

figure, axes = plt.subplots(figsize=(6, 3.5))
for name, (parameters, mean) in points.items():
    axes.plot(parameters, mean, "o")
    axes.annotate(name, (parameters, mean), textcoords="offset points", xytext=(6, 6))
axes.set(xscale="log", xlabel="parameters of the actor", ylabel=f"return, {EPISODES} episodes")
axes.margins(x=0.25, y=0.25)
figure.savefig("tour_parameters.png", bbox_inches="tight")


# %% [markdown]
# ## Deploy
#
# `export_policy` writes one C99 file with everything from the observation to the action, and checks
# that it acts as the model does.

# %%
print(export_policy(sparse, Path("tour_policy"), "c"))

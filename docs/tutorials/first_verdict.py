"""The tutorial first_verdict.md in Python; first_verdict.ipynb is made of it."""

# %% [markdown]
# # From nothing to a verdict
#
# Ten minutes: write a scenario, run it, see what theory promises, and compare the two. The same
# story with commands is [the tutorial](first_verdict.md). Install netkf with its pictures
# beforehand, `pip install "netkf[plot]"` or from a copy of its repository. The first run of each
# kind of filter compiles its code, which takes up to half a minute, once.

# %%
from pathlib import Path

import netkf

# %% [markdown]
# ## Write a scenario
#
# A target moves along a line. Three nodes stand in a row; the first and the last one see the
# target's position, the one in the middle sees nothing. Neighbours tell each other what they know
# twice a second on average, and one message in five is lost.

# %%
LINE = """\
format  = 1
name    = "line"
claim   = "a blind node follows the target by what its neighbours tell it"
horizon = 10.0            # simulated seconds
probe   = 0.5             # the states are sampled twice a second
seed    = 1

[plant]                   # position and speed: dx = A x dt + B dw
kind = "diffusion"
A    = [[0.0, 1.0], [0.0, -0.5]]
B    = [[0.0], [1.0]]
cov  = [[1.0, 0.0], [0.0, 1.0]]

[[sensors]]               # the two ends see the position: dy = H x dt + dv, cov(dv) = R dt
nodes = [0, 2]
H     = [[1.0, 0.0]]
R     = [[0.25]]

[network]                 # Poisson clocks at the links; both ends exchange their estimates
graph      = { kind = "path", nodes = 3 }
activation = { kind = "poisson", rate = 2.0 }
channel    = { loss = { kind = "bernoulli", delivery = 0.8 } }

[filter]                  # Kalman-Bucy filters that reset towards what they hear
kind    = "hybrid"
epsilon = 0.4
"""
Path("line.toml").write_text(LINE)
scenario = netkf.load("line.toml")

# %% [markdown]
# A mistake is answered with one line that says where, what and what to do. Here is one on purpose:

# %%
try:
    scenario.replace({"filter.epsilon": 0.7})
except netkf.ScenarioError as error:
    print(error)

# %% [markdown]
# ## Run it
#
# `x` is the truth, `xhat` and `P` are what each node believes; `events` and `states` are pandas
# tables. Node 1 is off by more than the others, and it knows: its P is larger too.

# %%
run = netkf.simulate(scenario)
errors = ((run.x[1:, None] - run.xhat[1:]) ** 2).sum(axis=2).mean(axis=0) ** 0.5
traces = run.P[1:].trace(axis1=2, axis2=3).mean(axis=0)
for node, rms, trace in zip(run.nodes, errors, traces, strict=True):
    print(f"node {node}: RMS error {rms:.4g}, mean trace P {trace:.4g}")
run.events.tail()

# %%
run.plot("error")

# %% [markdown]
# Would it do without the network? Any key can be changed:

# %%
alone = netkf.simulate(scenario.replace({"filter": netkf.parts.Local()}))
alone.P[1:].trace(axis1=2, axis2=3).mean(axis=0)

# %% [markdown]
# ## Ask theory
#
# No simulation: assumption by assumption, then the bound on the mean of P.

# %%
netkf.theory.assumptions(scenario)[["assumption", "holds", "evidence"]]

# %%
bound = netkf.theory.steady_covariance_bound(scenario).trace(axis1=1, axis2=2)
central = netkf.theory.central_covariance(scenario).trace()
print("bound by node:", bound.round(3), "- one filter with all readings:", central.round(4))

# %% [markdown]
# How fast must the links be for an error of at most 1.2 at every node? Theory has a bound and
# answers at once:

# %%
found = netkf.size(scenario, "network.activation.rate", 0.5, 50.0, "worst_rms<=1.2", by="theory")
print(f"{found.key} = {found.value:.4g}, {found.sure}")

# %% [markdown]
# ## Get the verdict
#
# `check` simulates many runs and holds every promise, of the papers and of the scenario itself,
# against them. `holds` means that the whole interval lies within the stated tolerance, `undecided`
# that fifty runs leave it too wide: `until="decided"` adds runs until no row is open.

# %%
verdict = netkf.check(scenario, runs=50)
print("no promise is broken:", bool(verdict))
verdict.table["verdict"].value_counts()

# %% [markdown]
# Where to go from here: [look at a run](../howto/look.md), [your own filter in 30
# lines](custom_filter.md), [from a recorded network to an answer](recorded_network.md), and
# [the reference](../scenario_files.md) of every key, option and file.

"""``python -m aolink.estimation.compiled``: what estimators would compile when they are first used, as of now."""

from aolink.estimation.compiled import make_ready

make_ready()

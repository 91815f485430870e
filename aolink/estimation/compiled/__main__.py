"""``python -m aolink.estimation.compiled``: compile now the code that estimators would compile when they are first
used."""

from aolink.estimation.compiled import GROUPS, make_ready

make_ready(*GROUPS)

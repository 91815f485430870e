"""Every pixel as a measurement: likelihood, modes of the posterior, mixtures."""

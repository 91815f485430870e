"""Every pixel as a measurement: likelihood, modes of the posterior, mixtures, importance sampling, tempering."""

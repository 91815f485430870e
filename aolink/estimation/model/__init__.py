"""The model of one exposure: start state, end state and path as one joint Gaussian, dense or factored."""

"""Commands of robots: register, data sets, training, correction."""

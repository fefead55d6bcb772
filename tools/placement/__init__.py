"""Where accelerometers sit and point: error variance, propositions, optimisation."""

"""How the enhancer learns: stages, samples, losses, and what it must keep to go on."""

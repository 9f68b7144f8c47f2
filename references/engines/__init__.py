"""Physics engines with fixed steps, each with its own model of mechanisms made of bodies and joints."""

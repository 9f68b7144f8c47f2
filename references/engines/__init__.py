"""Physics engines on mechanisms made of bodies and joints, each with a model of its own and a fixed step."""

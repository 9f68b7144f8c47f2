"""Steps of the integration methods: one module for each outer loop, and modules that several steps share."""

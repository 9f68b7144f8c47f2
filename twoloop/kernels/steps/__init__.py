"""Steps of the integration methods: one file for each outer loop, and files for common parts."""

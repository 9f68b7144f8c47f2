"""CasADi's integrators."""

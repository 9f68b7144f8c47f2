"""Control of steps of any method: step size, switching of methods, discontinuities, singular positions."""

"""Control of steps, whatever their formulas: step size, switching, discontinuities, singular positions."""

"""Motion against stops: impacts with restitution, and rest in contact."""

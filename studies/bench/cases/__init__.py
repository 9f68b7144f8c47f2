"""The mechanisms of which several studies make cases."""

"""heyoka."""

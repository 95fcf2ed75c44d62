"""The particle filter and the components that are injected into it."""

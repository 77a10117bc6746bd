"""The search for causes: candidates, screening, successive halving, model selection."""

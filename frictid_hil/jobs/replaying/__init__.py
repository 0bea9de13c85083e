"""Bus logs played back."""

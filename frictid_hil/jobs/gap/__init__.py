"""What the verbs of `gap` need beside the diagnosis."""

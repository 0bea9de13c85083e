"""One file per thing a user asks for; a job returns the mapping that ``--json`` prints."""

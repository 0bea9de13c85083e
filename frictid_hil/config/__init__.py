"""Files that people write and read: robot files, profiles, column maps, nominal joints - every error with its line."""

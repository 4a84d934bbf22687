"""Result folders and files: written completely or not at all, without removing other files."""

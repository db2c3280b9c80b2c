"""Parts and policies of a user, in this process or in one of their own."""

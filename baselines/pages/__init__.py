"""Pages of HTML that need no network: one file each, with their data, style and scripts inside."""

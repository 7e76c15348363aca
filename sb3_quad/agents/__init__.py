"""Controllers: asking them for actions, reading them from zips, finding them by name."""

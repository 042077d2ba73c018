"""Files that a kill cannot spoil, the form of their content, and what a result was made by."""

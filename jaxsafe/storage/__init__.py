"""Files that a kill cannot spoil, what their content must look like, and what a result was made by."""

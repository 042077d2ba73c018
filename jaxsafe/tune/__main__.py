"""`python -m jaxsafe.tune` runs the command in `jaxsafe/commands/tune.py`."""

if __name__ == "__main__":
    from jaxsafe.commands.tune import command

    command()

"""`python -m jaxsafe.train` runs the command in `jaxsafe/commands/train.py`."""

if __name__ == "__main__":
    from jaxsafe.commands.train import command

    command()

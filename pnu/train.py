"""`python -m pnu.train loss.w3=0.05`: the same as `pnu train loss.w3=0.05`."""

from pnu.commands.train import main

if __name__ == "__main__":
    main()

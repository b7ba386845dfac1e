"""The conformance suite of links to vehicles, in this environment."""

import sys

from retrim import Scenario, testing

if __name__ == "__main__":
    testing.check_vehicle(lambda: Scenario(plant=sys.argv[1]).make("small"), place=(0.3, -0.2, 1.5))
    print("it conforms")

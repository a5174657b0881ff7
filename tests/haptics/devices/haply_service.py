"""A Haply service in a separate process: prints its address, then its description for each line that it reads."""

import json
import sys

from haptics.devices.virtual.faults import Faults
from haptics.emulators.haply import make_haply_emulator

if __name__ == "__main__":
    with make_haply_emulator(None, sys.argv[1], Faults()) as service:
        print(service.address, flush=True)
        for _ in sys.stdin:
            print(json.dumps(service.describe()), flush=True)

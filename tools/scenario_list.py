"""Write the list of scenarios of seed 0 that the package contains, sim/scenario_list.json.

Run it after a scenario or a suite has been added, or the planning of trajectories has changed.
"""

import json
from dataclasses import asdict

from dronevio.sim.scenario_list import LIST_FILE, computed_list


def main() -> None:
    """Write the file."""
    text = json.dumps(asdict(computed_list(0)), indent=1, ensure_ascii=False)
    LIST_FILE.write_text(text + "\n", encoding="utf-8")
    print(f"wrote {LIST_FILE}")


if __name__ == "__main__":
    main()

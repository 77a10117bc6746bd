"""Sample the basins that are shipped with the gains of the default weights.

python bench/balance_basins.py        writes src/cg_control/config/balance_basins.yaml
"""

from pathlib import Path

import yaml

from cg_control.balancing.balance import BalanceSettings, balance_gains
from cg_control.balancing.basin import sample_basin
from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES

SAMPLE_TIME = 0.002
TARGET = Path(__file__).resolve().parents[1] / 'src/cg_control/config/balance_basins.yaml'


def main() -> None:
    model = Model.load(model_path('compass_gait_mit'))
    limit = float(model.torque_limit)
    gains = balance_gains(model, BalanceSettings(), SAMPLE_TIME)
    entry = {
        'model': model.name,
        'model_sha256': model.hash,
        'torque_limit': limit,
        'gains': {s: [float(f'{k:.6g}') for k in gains[s]] for s in STANCES},
        'bounds': {s: list(sample_basin(model, s, gains[s], limit).bounds) for s in STANCES},
    }
    text = '# Written by bench/balance_basins.py; cg_control/basin.py says what the bounds mean.\n'
    write_atomically(TARGET, text + yaml.safe_dump([entry], sort_keys=False))
    print(text + yaml.safe_dump([entry], sort_keys=False))


if __name__ == '__main__':
    main()

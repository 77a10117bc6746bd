"""Write the URDF of the robot from its model file: python tools/make_urdf.py."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1] / 'src' / 'cg_description'

if __name__ == '__main__':
    sys.path.insert(0, str(ROOT))
    from cg_description.model_file import load
    from cg_description.urdf import urdf

    file = load(ROOT / 'models' / 'compass_gait_mit.yaml')
    (ROOT / 'urdf' / 'compass_gait.urdf').write_text(urdf(file), encoding='utf-8')

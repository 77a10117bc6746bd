"""A machine with a joint that slides: identified, diagnosed and reported in its own units."""

import json
import math

import pytest
from cart_pole import cart, install

from cg_dynamics.rig import Setup
from cg_sysid import channels
from cg_sysid.channels import Channel, Mechanism, Topic
from cg_sysid.diagnose import diagnose
from cg_sysid.diagnose_cli import diagnosis_curves
from cg_sysid.diagnosis import Options
from cg_sysid.diagnosis_file import diagnosis_facts
from cg_sysid.identify import fit
from cg_sysid.intake import Intake
from cg_sysid.provenance import provenance
from cg_sysid.rehearse import rehearse
from cg_sysid.report.page import page
from cg_sysid.trial import prepare

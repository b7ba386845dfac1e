"""Makes the paper's tables and figures, one file each; a table is a function that takes a run and a reporter."""

from .ablation import ablation as ablation
from .buses import buses as buses
from .design import design as design
from .efficiency import efficiency as efficiency
from .everything import everything as everything
from .fast import fast as fast
from .gauntlet import gauntlet as gauntlet
from .hover import hover as hover
from .model import model as model
from .phase import phase as phase
from .plants import plants as plants
from .raptor import raptor as raptor
from .reversing import reversing as reversing
from .scaling import scaling as scaling
from .track import track as track
from .transfer import transfer as transfer
from .tuning import tuning as tuning
from .vision import vision as vision
from .where_learning_pays import where_learning_pays as where_learning_pays

TABLES = (
    hover, reversing, track, phase, vision, plants, model, fast, ablation, design, efficiency, transfer, raptor,
    buses, tuning, scaling, where_learning_pays,
)  # fmt: skip
"""Tables of ``retrim reproduce``; the gauntlet has its own command."""

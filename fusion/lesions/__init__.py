"""Where lesions are: from sightings in frames to places along the gut, with intervals."""

from fusion.lesions.locate import locate as locate
from fusion.lesions.sightings import Sighting as Sighting
from fusion.lesions.sightings import read_sightings as read_sightings
from fusion.lesions.table import Lesion as Lesion
from fusion.lesions.table import LesionTable as LesionTable
from fusion.lesions.table import read_lesions as read_lesions
from fusion.lesions.table import write_lesions as write_lesions

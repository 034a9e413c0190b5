from .collection import CollectionPlan, collect
from .dataset import DatasetError, Sample, read_samples
from .recordings import Reading, RecordedFrame, Recording, open_recording

__all__ = [
    "CollectionPlan",
    "DatasetError",
    "Reading",
    "RecordedFrame",
    "Recording",
    "Sample",
    "collect",
    "open_recording",
    "read_samples",
]

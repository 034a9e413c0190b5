from .trainer import TrainingError, TrainingPlan, train

__all__ = ["TrainingError", "TrainingPlan", "train"]

from .build import write_all
from .findings import Findings, summarise
from .html_report import write_report

__all__ = ["Findings", "summarise", "write_all", "write_report"]

"""What the runs of a sweep say together: settings compared over seeds, plots, texts, one page."""

from pnu.study.settings import Setting, Study, collect
from pnu.study.texts import write_report

__all__ = ["Setting", "Study", "collect", "write_report"]

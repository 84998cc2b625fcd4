"""Boards that cameras are calibrated from: what is printed on them, and where."""

from cuspid.model.board.boards import Board, BoardKind, BoardPattern, Dictionary
from cuspid.model.board.sets import BoardSet, Target

__all__ = ["Board", "BoardKind", "BoardPattern", "BoardSet", "Dictionary", "Target"]

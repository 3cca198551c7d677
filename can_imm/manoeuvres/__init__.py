"""Manoeuvres and the mode banks that detect them."""

from can_imm.manoeuvres.bank import PRESETS, ModeBank, bank_from_dict, builtin_presets, load_bank
from can_imm.types import Manoeuvre

__all__ = ["PRESETS", "Manoeuvre", "ModeBank", "bank_from_dict", "builtin_presets", "load_bank"]

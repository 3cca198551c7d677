"""Manoeuvres and the mode banks that detect them."""

from can_imm.manoeuvres.bank import (
    ModeBank,
    bank_from_dict,
    builtin_presets,
    load_bank,
    preset_data,
)
from can_imm.types import Manoeuvre

__all__ = ["Manoeuvre", "ModeBank", "bank_from_dict", "builtin_presets", "load_bank", "preset_data"]

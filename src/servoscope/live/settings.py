"""What the settings classes of a service file have in common."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["NotNegative", "Seconds", "Settings", "Word"]

NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
Seconds = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
Word = Annotated[str, Field(strict=True, min_length=1)]


class Settings(BaseModel):
    """Frozen; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")

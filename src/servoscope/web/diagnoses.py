"""diagnoses."""

from fastapi import APIRouter

router = APIRouter(tags=["diagnoses"])

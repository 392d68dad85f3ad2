"""designs."""

from fastapi import APIRouter

router = APIRouter(tags=["designs"])

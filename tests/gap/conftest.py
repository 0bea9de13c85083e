import sys
from pathlib import Path

# The makers of small sets live beside the tests that use them.
sys.path.insert(0, str(Path(__file__).parent))
